//! Limits how often an address or a vehicle may do something.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use gleaner_base::RateLimit;
use gleaner_fleet::listener::ClientNetwork;
use tokio::sync::Semaphore;

use crate::error::{CloudError, CloudResult};

/// Maximum number of keys that are remembered. With this many at once, those that have most left
/// are forgotten: untrusted peers choose keys, and must not fill the table for others.
const KEYS_MAX: usize = 20_000;
const KEYS_FORGOTTEN: usize = KEYS_MAX / 4;

/// Maximum number of frames of vehicles that are parsed and stored at a time: each may have 8 MiB.
const STORED_FRAMES_MAX: usize = 64;

#[derive(Debug)]
struct LimitOfEach<K> {
    limit: RateLimit,
    limits: Mutex<HashMap<K, RateLimit>>,
}

impl<K: Hash + Eq> LimitOfEach<K> {
    fn new(per_s: f64, burst: f64) -> Self {
        Self { limit: RateLimit::of(per_s, burst), limits: Mutex::default() }
    }

    /// Counts an attempt; above the limit, it is an error with this message and help.
    fn count(&self, key: K, message: impl FnOnce() -> String, help: &str) -> CloudResult<()> {
        match self.take(key, Instant::now()) {
            true => Ok(()),
            false => Err(CloudError::busy(message(), help)),
        }
    }

    fn take(&self, key: K, now: Instant) -> bool {
        let mut limits = self.limits.lock().unwrap_or_else(PoisonError::into_inner);
        if limits.len() >= KEYS_MAX && !limits.contains_key(&key) {
            let mut left: Vec<_> = limits.values().map(|limit| limit.left(now)).collect();
            let at = left.len() - KEYS_FORGOTTEN;
            let least = *left.select_nth_unstable_by(at, f64::total_cmp).1;
            limits.retain(|_, limit| limit.left(now) < least);
        }
        limits.entry(key).or_insert(self.limit).take(1.0, now)
    }
}

/// Wrong secrets of each network of clients, and passwords that were tried for each name: ten at
/// once, then one in six seconds.
#[derive(Debug)]
pub(crate) struct WrongSecrets {
    networks: LimitOfEach<ClientNetwork>,
    passwords: LimitOfEach<(ClientNetwork, String)>,
}

impl Default for WrongSecrets {
    fn default() -> Self {
        let (per_s, burst) = (1.0 / 6.0, 10.0);
        Self { networks: LimitOfEach::new(per_s, burst), passwords: LimitOfEach::new(per_s, burst) }
    }
}

impl WrongSecrets {
    /// Counts a wrong one; it is an error of its own if the network has sent too many. Those that
    /// are right are never refused: others of it, such as all behind a proxy, may use
    /// them.
    fn count(&self, network: ClientNetwork) -> CloudResult<()> {
        let message = || "too many wrong codes and tokens came from your address".to_owned();
        self.networks.count(network, message, "wait a minute, and use the newest code or token")
    }

    /// Returns the owner of a secret; a wrong one, which has none, is counted.
    pub(crate) fn check<T>(
        &self,
        network: ClientNetwork,
        owner: Option<T>,
        message: &str,
        help: &str,
    ) -> CloudResult<T> {
        if owner.is_none() {
            self.count(network)?;
        }
        owner.ok_or_else(|| CloudError::unknown(message, help))
    }

    /// Counts a password for a name before it is checked: unlike codes and tokens, passwords can be
    /// guessed, so that right ones are refused, too.
    pub(crate) fn count_password(&self, network: ClientNetwork, name: &str) -> CloudResult<()> {
        let message = || "too many passwords were tried for this name from your address".to_owned();
        let help = "wait a minute, or log in by a code that an administrator gives you";
        self.passwords.count((network, gleaner_base::excerpt(name)), message, help)
    }
}

/// Limits of each vehicle: one in a loop must cost little.
#[derive(Debug)]
pub(crate) struct VehicleLimits {
    /// Requests, which fetch a file each.
    requests: LimitOfEach<String>,
    /// Control channels. Healthy vehicles pause longer each time.
    links: LimitOfEach<String>,
    /// Certificates, each with an entry in the audit trail. Vehicles try once in an hour.
    renewals: LimitOfEach<String>,
    /// Frames that are parsed and stored at a time.
    pub(crate) frames: Semaphore,
}

impl Default for VehicleLimits {
    fn default() -> Self {
        Self {
            requests: LimitOfEach::new(10.0, 1000.0),
            links: LimitOfEach::new(0.2, 20.0),
            renewals: LimitOfEach::new(1.0 / 3600.0, 3.0),
            frames: Semaphore::new(STORED_FRAMES_MAX),
        }
    }
}

impl VehicleLimits {
    pub(crate) fn request(&self, vehicle: &str) -> CloudResult<()> {
        within(&self.requests, vehicle, "requests")
    }

    /// Counts a control channel of a vehicle.
    pub(crate) fn link(&self, vehicle: &str) -> CloudResult<()> {
        within(&self.links, vehicle, "connections")
    }

    pub(crate) fn renewal(&self, vehicle: &str) -> CloudResult<()> {
        within(&self.renewals, vehicle, "requests for a certificate")
    }
}

/// Changes of a user's own account, each with an entry in the audit trail, which keeps all of them:
/// twenty at once, then one a minute. Users of every role may make them.
#[derive(Debug)]
pub(crate) struct AccountChanges(LimitOfEach<String>);

impl Default for AccountChanges {
    fn default() -> Self {
        Self(LimitOfEach::new(1.0 / 60.0, 20.0))
    }
}

impl AccountChanges {
    pub(crate) fn count(&self, user: &str) -> CloudResult<()> {
        let message = || format!("user `{user}` has changed too much of the account at once");
        self.0.count(user.to_owned(), message, "wait a minute, and try again")
    }
}

fn within(limits: &LimitOfEach<String>, vehicle: &str, what: &str) -> CloudResult<()> {
    let message = || format!("vehicle `{vehicle}` has sent too many {what}");
    limits.count(vehicle.to_owned(), message, "wait, and pause longer after each attempt")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_secrets_of_one_network_do_not_stop_another_also_behind_a_proxy() {
        let wrong = WrongSecrets::default();
        let network = |address: &str| {
            let mut headers = axum::http::HeaderMap::new();
            headers.insert("x-forwarded-for", address.parse().unwrap());
            ClientNetwork::LOCAL.behind_proxy(&headers)
        };
        let (one, other) = (network("2001:db8::1"), network("2001:db8:1::1"));
        for last in 0..10 {
            let one = network(&format!("2001:db8::{last}"));
            assert!(wrong.count(one).is_ok());
            assert!(wrong.count_password(one, "ann").is_ok());
        }
        assert!(wrong.count(one).is_err());
        assert!(wrong.count_password(one, "ann").is_err());
        assert!(wrong.count(other).is_ok());
        assert!(wrong.count_password(one, "bea").is_ok());
        // Nor does it with ever new names, which fill the table again and again.
        for name in 0..2 * KEYS_MAX {
            assert!(wrong.count_password(one, &name.to_string()).is_ok());
        }
        assert!(wrong.count_password(other, "ann").is_ok());
    }

    #[test]
    fn a_full_table_refuses_neither_known_nor_new_keys_and_keeps_the_guilty_ones() {
        let (limits, now) = (LimitOfEach::new(1.0, 10.0), Instant::now());
        let take = |address: &str| limits.take(address.to_owned(), now);
        assert!((0..10).all(|_| take("guilty")) && !take("guilty"));
        assert!(take("known"));
        assert!((0..2 * KEYS_MAX).all(|peer| take(&peer.to_string())));
        assert!(limits.limits.lock().unwrap().len() <= KEYS_MAX);
        assert!(take("known") && take("new") && !take("guilty"));
    }

    #[test]
    fn a_vehicle_in_a_loop_is_refused_and_others_are_not() {
        let limits = VehicleLimits::default();
        let renewed = (0..10).filter(|_| limits.renewal("car-7").is_ok()).count();
        assert_eq!(renewed, 3);
        assert!(limits.renewal("car-8").is_ok() && limits.link("car-7").is_ok());
    }
}
