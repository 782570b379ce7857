//! Memory of a vehicle of what it has accepted, so that nothing older is accepted later, and of the
//! time. The caller persists it before it acts on what was accepted.

use std::collections::BTreeMap;

use gleaner_lambda::manifest::{ItemName, LambdaName, Sha256};
use serde::{Deserialize, Serialize};

use crate::{Deployment, Refusal, Revision, TrustRoot, Trusted, bounded};

/// Maximum number of deployments, and of lambdas, whose releases are remembered.
const NAMES_MAX: usize = 4096;
/// The furthest that a clock or a signed time can raise the trusted time above its anchor, and a
/// trust root the anchor, in seconds: a year.
const STEP: u64 = 366 * 86_400;
/// Longest text of floors, in bytes.
const TEXT_MAX: usize = 4 << 20;

/// The newest accepted releases, and the time. The default has accepted nothing.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Floors {
    root: u64,
    /// Anchor of the time: the newest time of signing of an accepted root, each within a year of
    /// the one before or of the build.
    root_time: u64,
    /// The last trusted time.
    time: u64,
    #[serde(deserialize_with = "bounded::map::<_, _, _, NAMES_MAX>")]
    deployments: BTreeMap<ItemName, Accepted>,
    #[serde(deserialize_with = "bounded::map::<_, _, _, NAMES_MAX>")]
    lambdas: BTreeMap<LambdaName, Accepted>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accepted {
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

    /// Raises the last trusted time to `clock`, but at most to a year after the anchor: the newest
    /// accepted trust root or `built`, whichever is later.
    ///
    /// So a clock that was far ahead for a while does not expire everything for ever, and a clock
    /// that is set back does not revive what had expired within that year.
    pub fn observe(&mut self, clock: u64, built: u64) {
        self.time = self.time.max(clock.min(self.most(built)));
    }

    /// Returns whether the last trusted time is later than that of `other` by `seconds` at least.
    pub fn is_later(&self, other: &Floors, seconds: u64) -> bool {
        self.time >= other.time.saturating_add(seconds)
    }

    /// Checks a deployment of `revision` again, and remembers both. `built` is as in
    /// [`now`](Self::now). The time of signing counts as the clock of [`observe`](Self::observe):
    /// a deployer can move the trusted time up to the anchor's year, and never the anchor.
    ///
    /// # Errors
    ///
    /// [`Refusal::OtherRevision`], and those of the releases: [`Refusal::RolledBack`],
    /// [`Refusal::SameRelease`], [`Refusal::TooManyFloors`]. Nothing is remembered then.
    pub fn accept(
        &mut self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
        built: u64,
    ) -> Result<(), Refusal> {
        let (wish, release) = (deployment.payload(), revision.payload());
        if wish.revision != *revision.digest() {
            let (wanted, found) = (wish.revision.to_string(), Some(revision.digest().clone()));
            return Err(Refusal::OtherRevision { role: "revision", wanted, found });
        }
        if !self.has_accepted(deployment) {
            self.check_new(deployment, revision)?;
            let accepted = |release, digest: &Sha256| Accepted { release, digest: digest.clone() };
            let deployed = accepted(wish.release, deployment.digest());
            self.deployments.insert(wish.id.clone(), deployed);
            let released = accepted(release.release, revision.digest());
            self.lambdas.insert(release.name.clone(), released);
        }
        self.observe(wish.created, built);
        Ok(())
    }

    /// Returns the newest accepted release of each deployment, also of removed ones.
    pub fn releases(&self) -> impl Iterator<Item = (&ItemName, u64)> {
        self.deployments.iter().map(|(id, accepted)| (id, accepted.release))
    }

    /// Remembers an accepted trust root. A root that is not newer changes nothing.
    ///
    /// The caller persists the file of the root first, and these floors second. After a kill
    /// between the two, the new root is opened again with the old floors, and this call repeated.
    /// In the other order, the vehicle would have only a root that its floors refuse.
    pub fn accept_root(&mut self, root: &TrustRoot, built: u64) {
        if root.version > self.root {
            self.root = root.version;
            // A time far ahead, by a wrong clock of the signer, moves the anchor by a year at most.
            self.root_time = self.root_time.max(root.created.min(self.most(built)));
            self.time = self.time.max(self.root_time);
        }
    }

    /// The latest time to which a clock or a signed time can raise the trusted time.
    fn most(&self, built: u64) -> u64 {
        self.root_time.max(built).saturating_add(STEP)
    }

    pub(crate) fn check_root(&self, version: u64) -> Result<(), Refusal> {
        match version < self.root {
            true => Err(Refusal::OldRoot { found: version, floor: self.root }),
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

    /// Checks that a deployment and its revision may be accepted for the first time.
    pub(crate) fn check_new(
        &self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
    ) -> Result<(), Refusal> {
        let (id, release) = (&deployment.payload().id, deployment.payload().release);
        let what = || format!("deployment `{id}`");
        check(&self.deployments, id, what, release, deployment.digest())?;
        let (name, release) = (&revision.payload().name, revision.payload().release);
        check(&self.lambdas, name, || lambda(name), release, revision.digest())
    }

    /// Checks a fallback, which may have a lower release than one accepted before if it `is_known`
    /// here.
    pub(crate) fn check_fallback(
        &self,
        fallback: &Trusted<Revision>,
        is_known: bool,
    ) -> Result<(), Refusal> {
        let (name, release) = (&fallback.payload().name, fallback.payload().release);
        match self.lambdas.get(name) {
            Some(floor) if release == floor.release && *fallback.digest() != floor.digest => {
                let (accepted, found) = (floor.digest.clone(), fallback.digest().clone());
                Err(Refusal::SameRelease { what: lambda(name), release, accepted, found })
            }
            Some(floor) if release < floor.release && !is_known => {
                Err(Refusal::UnknownFallback { fallback: release, floor: floor.release })
            }
            _ => Ok(()),
        }
    }
}

fn lambda(name: &LambdaName) -> String {
    format!("lambda `{name}`")
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
            Err(Refusal::SameRelease { what: what(), release, accepted, found })
        }
        None if floors.len() >= NAMES_MAX => Err(Refusal::TooManyFloors { count: floors.len() }),
        _ => Ok(()),
    }
}
