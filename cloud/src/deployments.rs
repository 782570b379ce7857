//! Deployments are received, changed and removed, and the vehicles that they are for are woken.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Failure, excerpt};
use gleaner_fleet::people::FleetDeployRequest;
use gleaner_fleet::waves::WaveState;
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::{
    DeployReply, DeploymentEnvelopes, GrantStatus, RevisionEnvelope,
};
use gleaner_trust::{Refusal, Revision, unverified_deployment, unverified_revision};

use crate::error::{CloudError, CloudResult};
use crate::hub::Hub;
use crate::objects::Objects;
use crate::store::{ChangeAuthor, CloudStore, OfferedDeployment};
use crate::ticks::ticks;

const WAVES_INTERVAL: Duration = Duration::from_secs(2);

pub(crate) struct Deployments {
    store: Arc<CloudStore>,
    hub: Arc<Hub>,
    objects: Arc<Objects>,
}

impl Deployments {
    pub(crate) fn new(store: &Arc<CloudStore>, hub: &Arc<Hub>, objects: &Arc<Objects>) -> Self {
        let (store, hub, objects) = (Arc::clone(store), Arc::clone(hub), Arc::clone(objects));
        Self { store, hub, objects }
    }

    /// Stores a deployment, or answers with the files that are missing for it.
    pub(crate) async fn deploy(
        &self,
        author: ChangeAuthor<'_>,
        request: FleetDeployRequest,
    ) -> CloudResult<DeployReply> {
        let refused = |what: &str| {
            let action = format!("the {what} is refused");
            move |refusal: Refusal| CloudError::from(Failure::because(action, &refusal))
        };
        let deployment =
            unverified_deployment(request.deployment.as_bytes()).map_err(refused("deployment"))?;
        let mut sent = BTreeMap::new();
        for envelope in request.revisions.into_iter().take(2) {
            let (revision, digest) =
                unverified_revision(envelope.as_bytes()).map_err(refused("revision"))?;
            sent.insert(digest, (revision, envelope));
        }
        let named: Vec<&Sha256> = [Some(&deployment.revision), deployment.fallback.as_ref()]
            .into_iter()
            .flatten()
            .collect();
        let mut revisions: Vec<Revision> = Vec::new();
        let mut envelopes = BTreeMap::new();
        for digest in named {
            let (revision, envelope) = match sent.remove(digest) {
                Some(sent) => sent,
                None => self.stored(digest).await?,
            };
            revisions.push(revision);
            envelopes.insert(digest.to_string(), envelope);
        }
        let id = deployment.id.to_string();
        // What is not missing now is not removed until the deployment needs it.
        let _uses = self.objects.uses.read().await;
        let objects = self.objects.missing(&revisions).await?;
        self.store.await_files(&id, &objects).await?;
        if !objects.is_empty() {
            return Ok(DeployReply::Missing { objects });
        }
        let grants = deployment.grants;
        let grants = GrantStatus {
            topics: grants.topics.iter().map(ToString::to_string).collect(),
            models: grants.models.iter().map(ToString::to_string).collect(),
            record: grants.record,
        };
        let selector = deployment.selector.into_iter().map(|(name, it)| (name.to_string(), it));
        let offered = OfferedDeployment {
            id: id.clone(),
            release: deployment.release,
            envelope: request.deployment,
            revision: deployment.revision.to_string(),
            fallback: deployment.fallback.map(|it| it.to_string()),
            grants,
            selector: selector.collect(),
            revisions: envelopes,
            waves: request.waves,
        };
        let (generation, changed) = self.store.deploy(author, &offered).await?;
        self.hub.wake(&changed);
        Ok(DeployReply::Accepted { id, attempt: 0, generation })
    }

    /// Returns the signed parts of a deployment, for those who sign the next one.
    pub(crate) async fn envelopes(&self, id: &str) -> CloudResult<DeploymentEnvelopes> {
        let deployment = self.store.newest_envelope(id).await?;
        let wish = unverified_deployment(deployment.as_bytes())
            .map_err(|error| Failure::because("the stored deployment is damaged", &error))?;
        let mut revisions = Vec::new();
        for digest in std::iter::once(&wish.revision).chain(&wish.fallback) {
            let (revision, envelope) = self.stored(digest).await?;
            let manifest = self.objects.manifest(&revision).await?;
            revisions.push(RevisionEnvelope { envelope, manifest });
        }
        Ok(DeploymentEnvelopes { deployment, revisions })
    }

    async fn stored(&self, digest: &Sha256) -> CloudResult<(Revision, String)> {
        let missing = || {
            let message = format!("the deployment names revision {digest}, which was not sent");
            CloudError::usage(message, "send its file, too, as the revision or the fallback")
        };
        let envelope = self.store.revision(digest.as_str()).await?.ok_or_else(missing)?;
        let parsed = unverified_revision(envelope.as_bytes());
        let (revision, _) =
            parsed.map_err(|error| Failure::because("a stored revision is damaged", &error))?;
        Ok((revision, envelope))
    }

    /// Makes a change that its name states.
    pub(crate) async fn change(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
        change: &str,
    ) -> CloudResult<()> {
        let (store, author) = (&self.store, author.into());
        let changed = match change {
            "start" => store.set_wanted(author, id, true).await?,
            "stop" => store.set_wanted(author, id, false).await?,
            "rollback" => store.roll_back(author, id).await?,
            "pause" => store.steer_waves(author, id, WaveState::Paused).await?,
            "resume" => store.steer_waves(author, id, WaveState::Running).await?,
            "abort" => store.steer_waves(author, id, WaveState::Aborted).await?,
            other => {
                let message = format!("`{}` is not a change of a deployment", excerpt(other));
                let help = "use `start`, `stop`, `rollback`, `pause`, `resume` or `abort`";
                return Err(CloudError::usage(message, help));
            }
        };
        self.hub.wake(&changed);
        Ok(())
    }

    pub(crate) async fn remove(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
    ) -> CloudResult<()> {
        let changed = self.store.remove_deployment(author, id).await?;
        self.hub.wake(&changed);
        Ok(())
    }

    /// Advances the waves of releases, for as long as this process runs.
    pub(crate) async fn advance_waves(&self) {
        let mut ticks = ticks(WAVES_INTERVAL);
        loop {
            ticks.tick().await;
            match self.store.advance_waves().await {
                Ok(changed) => self.hub.wake(&changed),
                Err(error) => {
                    tracing::warn!(reason = error.reason(), "could not advance waves; will retry");
                }
            }
        }
    }
}
