//! Memory of a vehicle of what it has accepted, so that nothing older is accepted later, and of the
//! time. The caller persists it before it acts on what was accepted.

use std::collections::BTreeMap;

use gleaner_lambda::manifest::{ItemName, LambdaName, Sha256};
use serde::{Deserialize, Serialize};

use crate::{Deployment, Refusal, Revision, TrustRoot, Trusted, bounded};

/// Maximum number of deployments, and of lambdas, whose releases are remembered.
const NAMES_MAX: usize = 4096;
/// The furthest that one clock or one signed time can move the floor of time, in seconds: a year.
const STEP: u64 = 366 * 86_400;
/// Longest text of floors.
const TEXT_MAX: usize = 4 << 20;

/// The newest accepted releases, and the time. The default has accepted nothing.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Floors {
    root: u64,
    /// The newest time in accepted deployments and roots.
    signed_time: u64,
    time: u64,
    #[serde(deserialize_with = "bounded::map::<_, _, _, NAMES_MAX>")]
    deployments: BTreeMap<ItemName, Accepted>,
    #[serde(deserialize_with = "bounded::map::<_, _, _, NAMES_MAX>")]
    lambdas: BTreeMap<LambdaName, Accepted>,
}

/// A release that was accepted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accepted {
    /// Its number.
    pub release: u64,
    /// Its digest: two releases with one number differ in it.
    #[serde(deserialize_with = "bounded::text")]
    pub digest: Sha256,
}

impl Floors {
    /// Parses the text of [`to_json`](Self::to_json).
    ///
    /// # Errors
    ///
    /// [`Refusal::TooLarge`], [`Refusal::Malformed`].
    pub fn parse(text: &[u8]) -> Result<Self, Refusal> {
        const WHAT: &str = "state of accepted releases";
        if text.len() > TEXT_MAX {
            let most = gleaner_base::ByteSize::mib(4);
            return Err(Refusal::TooLarge { what: WHAT, bytes: text.len() as u64, most });
        }
        serde_json::from_slice(text)
            .map_err(|error| Refusal::Malformed { what: WHAT, reason: error.to_string() })
    }

    /// Returns its text, to persist it.
    pub fn to_json(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("text keys and whole numbers")
    }

    /// Returns the time to verify with, in seconds since 1970: `clock`, unless it is earlier than
    /// the last trusted time or than `built`, the time at which this program was built.
    pub fn now(&self, clock: u64, built: u64) -> u64 {
        clock.max(self.time).max(built)
    }

    /// Raises the last trusted time to `clock`, but at most to a year after the newest signed time.
    ///
    /// So a clock that was far ahead for a while does not expire everything for ever, and a clock
    /// that is set back does not revive what had expired within that year.
    pub fn observe(&mut self, clock: u64, built: u64) {
        let most = self.signed_time.max(built).saturating_add(STEP);
        self.time = self.time.max(clock.min(most));
    }

    /// Remembers an accepted deployment of `revision`. `built` is as in [`now`](Self::now).
    pub fn accept(
        &mut self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
        built: u64,
    ) {
        let (wish, release) = (deployment.payload(), revision.payload());
        raise(&mut self.deployments, &wish.id, wish.release, deployment.digest());
        raise(&mut self.lambdas, &release.name, release.release, revision.digest());
        self.accept_time(wish.created, built);
    }

    /// Remembers an accepted trust root.
    pub fn accept_root(&mut self, root: &TrustRoot, built: u64) {
        self.root = self.root.max(root.version);
        self.accept_time(root.created, built);
    }

    /// A signed time far ahead, by a wrong clock of the signer, moves the floor by a year at most.
    fn accept_time(&mut self, created: u64, built: u64) {
        let most = self.signed_time.max(built).saturating_add(STEP);
        self.signed_time = self.signed_time.max(created.min(most));
        self.time = self.time.max(self.signed_time);
    }

    pub(crate) fn check_root(&self, version: u64) -> Result<(), Refusal> {
        match version < self.root {
            true => Err(Refusal::RolledBack {
                what: "trust root".to_owned(),
                found: version,
                floor: self.root,
            }),
            false => Ok(()),
        }
    }

    /// Returns whether exactly this deployment was accepted before.
    pub(crate) fn has_accepted(&self, deployment: &Trusted<Deployment>) -> bool {
        self.deployments.get(&deployment.payload().id).is_some_and(|accepted| {
            accepted.release == deployment.payload().release
                && accepted.digest == *deployment.digest()
        })
    }

    pub(crate) fn check_deployment(&self, it: &Trusted<Deployment>) -> Result<(), Refusal> {
        let (id, release) = (&it.payload().id, it.payload().release);
        check(&self.deployments, id, || format!("deployment `{id}`"), release, it.digest())
    }

    pub(crate) fn check_lambda(&self, it: &Trusted<Revision>) -> Result<(), Refusal> {
        let (name, release) = (&it.payload().name, it.payload().release);
        check(&self.lambdas, name, || format!("lambda `{name}`"), release, it.digest())
    }
}

fn check<K: Ord>(
    floors: &BTreeMap<K, Accepted>,
    name: &K,
    what: impl Fn() -> String,
    release: u64,
    digest: &Sha256,
) -> Result<(), Refusal> {
    match floors.get(name) {
        Some(floor) if release < floor.release => {
            Err(Refusal::RolledBack { what: what(), found: release, floor: floor.release })
        }
        Some(floor) if release == floor.release && *digest != floor.digest => {
            let (accepted, found) = (floor.digest.clone(), digest.clone());
            Err(Refusal::SameRelease { what: what(), accepted, found })
        }
        None if floors.len() >= NAMES_MAX => Err(Refusal::TooManyFloors { count: floors.len() }),
        _ => Ok(()),
    }
}

fn raise<K: Ord + Clone>(
    floors: &mut BTreeMap<K, Accepted>,
    name: &K,
    release: u64,
    digest: &Sha256,
) {
    if floors.get(name).is_none_or(|floor| floor.release < release) {
        floors.insert(name.clone(), Accepted { release, digest: digest.clone() });
    }
}
