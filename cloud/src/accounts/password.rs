//! Passwords: hashed with Argon2id, a few at a time.

use std::sync::LazyLock;
use std::time::Duration;

use argon2::password_hash::phc::PasswordHash;
use argon2::password_hash::{PasswordHasher, PasswordVerifier};
use argon2::{Algorithm, Argon2, Params, Version};
use gleaner_fleet::listener::{ClientNetwork, FairTurns};
use tokio::time::timeout;

use crate::error::{CloudError, CloudResult};

/// Hashes at a time, each of 19 MiB and a core: a network with many connections delays others by
/// one hash, not by all of its own.
static TURNS: LazyLock<FairTurns> = LazyLock::new(|| FairTurns::new(2, WAITING_MAX));
/// Maximum number of passwords of a network that wait.
const WAITING_MAX: usize = 50;
/// Time to wait for a turn.
const WAIT: Duration = Duration::from_secs(10);

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
    // Users who are logged in wait for one password of each network at most.
    let hash = move || argon2()?.hash_password(password.as_bytes()).map(|it| it.to_string());
    work(ClientNetwork::LOCAL, hash).await?.map_err(|error| {
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
    let is_equal = work(network, move || {
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

fn busy() -> CloudError {
    CloudError::busy("too many passwords are being checked", "try again in a minute")
}

async fn work<T: Send + 'static>(
    network: ClientNetwork,
    hash: impl FnOnce() -> T + Send + 'static,
) -> CloudResult<T> {
    let turn = timeout(WAIT, TURNS.take(network)).await.ok().flatten().ok_or_else(busy)?;
    // The turn is given back when the work ends, not when the browser leaves.
    let done = tokio::task::spawn_blocking(move || {
        let _turn = turn;
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
