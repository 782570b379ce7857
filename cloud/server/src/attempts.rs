//! Limits how many wrong secrets an address may send.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use gleaner_base::RateLimit;

use crate::error::{CloudError, CloudResult};

/// Wrong secrets of an address: ten at once, then one in six seconds.
const LIMIT: RateLimit = RateLimit::of(1.0 / 6.0, 10.0);
/// Maximum number of limits that are remembered.
const LIMITS_MAX: usize = 10_000;

/// Wrong secrets of each address, and passwords that were tried for each name.
#[derive(Debug, Default)]
pub(crate) struct WrongSecrets {
    addresses: KeyLimits<IpAddr>,
    passwords: KeyLimits<(IpAddr, String)>,
}

impl WrongSecrets {
    /// Counts a wrong one; it is an error of its own if the address has sent too many. Those that
    /// are right are never refused: others at the address, such as all behind a proxy, may use
    /// them.
    pub(crate) fn count(&self, address: IpAddr) -> CloudResult<()> {
        match self.addresses.take(address, [0; 4].into()) {
            true => Ok(()),
            false => Err(CloudError::busy(
                "too many wrong codes and tokens came from your address",
                "wait a minute, and use the newest code or token",
            )),
        }
    }

    /// Counts a password before it is checked: unlike codes and tokens, passwords can be guessed,
    /// so that right ones are refused, too.
    pub(crate) fn count_password(&self, address: IpAddr, name: &str) -> CloudResult<()> {
        let name = gleaner_base::excerpt(name);
        match self.passwords.take((address, name), ([0; 4].into(), String::new())) {
            true => Ok(()),
            false => Err(CloudError::busy(
                "too many passwords were tried for this name from your address",
                "wait a minute, or log in by a code that an administrator gives you",
            )),
        }
    }
}

#[derive(Debug)]
struct KeyLimits<K>(Mutex<HashMap<K, RateLimit>>);

impl<K> Default for KeyLimits<K> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K: Eq + Hash> KeyLimits<K> {
    /// Takes one of a key; returns whether there was one left. With very many keys at once, further
    /// ones share the limit of `shared`.
    fn take(&self, key: K, shared: K) -> bool {
        let now = Instant::now();
        let mut limits = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if limits.len() >= LIMITS_MAX {
            limits.retain(|_, limit| !limit.clone().take(10.0, now));
        }
        let key = if limits.len() < LIMITS_MAX { key } else { shared };
        limits.entry(key).or_insert(LIMIT).take(1.0, now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_secrets_of_one_address_do_not_stop_another() {
        let (wrong, one, other) = (WrongSecrets::default(), [10, 0, 0, 1], [10, 0, 0, 2]);
        for _ in 0..10 {
            assert!(wrong.count(one.into()).is_ok());
            assert!(wrong.count_password(one.into(), "ann").is_ok());
        }
        assert!(wrong.count(one.into()).is_err());
        assert!(wrong.count_password(one.into(), "ann").is_err());
        assert!(wrong.count(other.into()).is_ok());
        assert!(wrong.count_password(one.into(), "bea").is_ok());
        assert!(wrong.count_password(other.into(), "ann").is_ok());
    }
}
