//! Passwords: hashed with Argon2id, a few at a time.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use argon2::password_hash::phc::PasswordHash;
use argon2::password_hash::{PasswordHasher, PasswordVerifier};
use argon2::{Algorithm, Argon2, Params, Version};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use crate::clients::ClientNetwork;
use crate::error::{CloudError, CloudResult};

/// Number of hashes at a time: each takes 19 MiB and a core.
static SLOTS: Semaphore = Semaphore::const_new(2);
/// Time to wait for one of them.
const WAIT: Duration = Duration::from_secs(10);

/// The turn of each network whose passwords are checked. It has one at a time, so that a network
/// with many connections delays others by one hash, not by all of its own.
static TURNS: Mutex<BTreeMap<ClientNetwork, Arc<Semaphore>>> = Mutex::new(BTreeMap::new());
/// Maximum number of passwords of a network that wait or are checked.
const WAITING_MAX: usize = 50;

/// Lengths of passwords, in bytes.
const LENGTHS: std::ops::RangeInclusive<usize> = 12..=256;

/// Memory in KiB, rounds and lanes, as OWASP recommends for Argon2id.
const COSTS: (u32, u32, u32) = (19 * 1024, 2, 1);

/// A hash of no password, so that a name that does not exist takes as long as one that does.
const NO_PASSWORD: &str = "$argon2id$v=19$m=19456,t=2,p=1$Z2xlYW5lci1uby11c2Vy\
                           $AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA";

/// Returns the hash of a new password, in the PHC format.
pub(super) async fn hashed(password: String) -> CloudResult<String> {
    if !LENGTHS.contains(&password.len()) {
        let message = format!("a password has {} to {} bytes", LENGTHS.start(), LENGTHS.end());
        return Err(CloudError::usage(message, "choose another one, such as four random words"));
    }
    let hash = work(move || argon2()?.hash_password(password.as_bytes()).map(|it| it.to_string()));
    hash.await?.map_err(|error| {
        CloudError::busy("the password cannot be hashed", "try again").because(error)
    })
}

/// Returns whether a password, from this network, is the one with this hash; without a hash, none
/// is.
pub(super) async fn is_right(
    network: ClientNetwork,
    password: String,
    hash: Option<&str>,
) -> CloudResult<bool> {
    if password.len() > *LENGTHS.end() {
        return Ok(false);
    }
    let stored = hash.unwrap_or(NO_PASSWORD).to_owned();
    let turn = turn_of(network)?;
    let turn = timeout(WAIT, turn.acquire_owned()).await.map_err(|_| busy())?;
    let turn = turn.map_err(|_| busy())?;
    let is_equal = work(move || {
        // As for the slot: it ends with the work.
        let _turn = turn;
        let hash = PasswordHash::new(&stored).ok()?;
        argon2().ok()?.verify_password(password.as_bytes(), &hash).ok()
    });
    Ok(is_equal.await?.is_some() && hash.is_some())
}

fn argon2() -> argon2::password_hash::Result<Argon2<'static>> {
    let (memory, rounds, lanes) = COSTS;
    let params = Params::new(memory, rounds, lanes, None)
        .map_err(|_| argon2::password_hash::Error::ParamsInvalid)?;
    Ok(Argon2::new(Algorithm::Argon2id, Version::V0x13, params))
}

fn turn_of(network: ClientNetwork) -> CloudResult<Arc<Semaphore>> {
    let mut turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
    turns.retain(|_, turn| Arc::strong_count(turn) > 1);
    let turn = turns.entry(network).or_insert_with(|| Arc::new(Semaphore::new(1)));
    match Arc::strong_count(turn) > WAITING_MAX {
        true => Err(busy()),
        false => Ok(Arc::clone(turn)),
    }
}

fn busy() -> CloudError {
    CloudError::busy("too many passwords are being checked", "try again in a minute")
}

async fn work<T: Send + 'static>(hash: impl FnOnce() -> T + Send + 'static) -> CloudResult<T> {
    let slot = timeout(WAIT, SLOTS.acquire()).await.map_err(|_| busy())?.map_err(|_| busy())?;
    // The slot is given back when the work ends, not when the browser leaves.
    let done = tokio::task::spawn_blocking(move || {
        let _slot = slot;
        hash()
    });
    done.await.map_err(|_| busy())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn only_the_same_password_is_right() {
        let hash = hashed("correct horse battery".to_owned()).await.unwrap();
        assert!(hash.starts_with("$argon2id$v=19$m=19456,t=2,p=1$"), "{hash}");
        let network = ClientNetwork::of([10, 0, 0, 1].into());
        let is_right =
            async |password: &str, hash| is_right(network, password.to_owned(), hash).await;
        assert!(is_right("correct horse battery", Some(&hash)).await.unwrap());
        assert!(!is_right("correct horse batterx", Some(&hash)).await.unwrap());
        assert!(!is_right("correct horse battery", None).await.unwrap());
        assert!(!is_right("correct horse battery", Some("damaged")).await.unwrap());
        assert!(PasswordHash::new(NO_PASSWORD).is_ok());
        assert!(hashed("short".to_owned()).await.is_err());
    }
}
