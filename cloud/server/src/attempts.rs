//! Limits how many wrong secrets an address may send.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use gleaner_base::RateLimit;

use crate::error::{CloudError, CloudResult};

/// Wrong secrets of an address: ten at once, then one in six seconds.
const LIMIT: RateLimit = RateLimit::of(1.0 / 6.0, 10.0);
/// Maximum number of addresses that are remembered.
const ADDRESSES_MAX: usize = 10_000;

/// Wrong secrets of each address.
#[derive(Debug, Default)]
pub(crate) struct WrongSecrets(Mutex<HashMap<IpAddr, RateLimit>>);

impl WrongSecrets {
    /// Counts a wrong one; it is an error of its own if the address has sent too many. Those that
    /// are right are never refused: others at the address, such as all behind a proxy, may use
    /// them.
    pub(crate) fn count(&self, address: IpAddr) -> CloudResult<()> {
        let now = Instant::now();
        let mut limits = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if limits.len() >= ADDRESSES_MAX {
            limits.retain(|_, limit| !limit.clone().take(10.0, now));
        }
        // With this many at once, further ones share the limit of one address.
        let key = if limits.len() < ADDRESSES_MAX { address } else { IpAddr::from([0; 4]) };
        match limits.entry(key).or_insert(LIMIT).take(1.0, now) {
            true => Ok(()),
            false => Err(CloudError::busy(
                "too many wrong codes and tokens came from your address",
                "wait a minute, and use the newest code or token",
            )),
        }
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
        }
        assert!(wrong.count(one.into()).is_err());
        assert!(wrong.count(other.into()).is_ok());
    }
}
