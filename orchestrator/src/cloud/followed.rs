//! The newest state of the cloud that the vehicle has followed: a cloud that was restored from a
//! backup has an older one, and does not know what was deployed since.

use gleaner_base::Failure;
use gleaner_trust::sha256;

use super::settings::CloudSettings;
use crate::orchestrator::Orchestrator;
use crate::state::FollowedState;

impl CloudSettings {
    /// Returns the digest by which the vehicle remembers this cloud.
    pub(super) fn authority_digest(&self) -> String {
        sha256(self.authority.as_bytes()).to_string()
    }
}

impl Orchestrator {
    /// Returns the number of the newest state of a cloud that was followed. `authority` is the
    /// SHA-256 of the certificate of its authority.
    pub(crate) fn followed(&self, authority: &str) -> u64 {
        let inner = self.lock();
        let followed = &inner.state.followed;
        if followed.authority == authority { followed.generation } else { 0 }
    }

    /// Makes local what another cloud than that of this authority has deployed. This one does not
    /// know it, and would end it.
    pub(crate) fn leave_other_cloud(&self, authority: &str) -> Result<(), Failure> {
        let mut inner = self.lock();
        let before = &inner.state.followed.authority;
        if before.is_empty() || before == authority {
            return Ok(());
        }
        inner.change(|state| {
            state.followed = FollowedState { authority: authority.to_owned(), generation: 0 };
            state.deployments.values_mut().for_each(|deployed| deployed.cloud = None);
        })?;
        self.publish(&mut inner);
        Ok(())
    }

    /// Remembers the newest state of a cloud that was followed.
    pub(crate) fn note_followed(&self, authority: String, generation: u64) -> Result<(), Failure> {
        let mut inner = self.lock();
        let before = &inner.state.followed;
        if before.authority == authority && before.generation >= generation {
            return Ok(());
        }
        inner.change(|state| state.followed = FollowedState { authority, generation })?;
        self.publish(&mut inner);
        Ok(())
    }
}
