//! A deployment whose signatures, files and settings were checked, and what runs by it.

use gleaner_base::text::list;
use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::{ConfigSet, ItemName, Sha256};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::supervision::DesiredLambda;
use gleaner_protocol::vehicle_api::{DeploymentStatus, GrantStatus, RevisionStatus};
use gleaner_trust::{Deployment, Refusal, Revision, Trusted, Verifier, sha256};

use crate::state::Deployed;
use crate::store::RevisionStore;

/// A deployment with its revisions, as their keys signed them.
pub(crate) struct SignedDeployment {
    pub(crate) deployment: Trusted<Deployment>,
    /// SHA-256 of its envelope.
    envelope: Sha256,
    pub(crate) revision: Trusted<Revision>,
    pub(crate) fallback: Option<Trusted<Revision>>,
    /// Overrides of the config that its fallback knows.
    fallback_set: Vec<(String, String)>,
}

impl SignedDeployment {
    /// Verifies the deployment in `envelope`. `find` returns the envelope of a revision.
    pub(crate) fn verify(
        verifier: &Verifier<'_>,
        envelope: &[u8],
        find: impl Fn(&Sha256) -> Option<Vec<u8>>,
    ) -> Result<Self, Failure> {
        let refused = |refusal| Failure::because("the deployment is refused", &refusal);
        let deployment = verifier.deployment(envelope).map_err(refused)?;
        let revision = |role: &str, digest: &Sha256| {
            let envelope = find(digest).ok_or_else(|| {
                let message = format!("the {role} {digest} of the deployment is unknown here");
                Failure::new(Exit::Usage, message)
                    .with_help("send its `revision.json` with the deployment")
            })?;
            verifier
                .revision(&envelope)
                .map_err(|it| Failure::because(format!("the {role} is refused"), &it))
        };
        let wish = deployment.payload();
        let fallback = wish.fallback.as_ref().map(|it| revision("fallback", it)).transpose()?;
        let revision = revision("revision", &wish.revision)?;
        verifier.admit(&deployment, &revision, fallback.as_ref()).map_err(refused)?;
        let envelope = sha256(envelope);
        Ok(Self { deployment, envelope, revision, fallback, fallback_set: Vec::new() })
    }

    pub(crate) fn id(&self) -> &ItemName {
        &self.deployment.payload().id
    }

    pub(crate) fn digests(&self) -> impl Iterator<Item = &Sha256> {
        self.revisions().map(Trusted::digest)
    }

    pub(crate) fn revisions(&self) -> impl Iterator<Item = &Trusted<Revision>> {
        std::iter::once(&self.revision).chain(&self.fallback)
    }

    /// Checks that the manifests of its revisions, which are in `store`, fit its grants and its
    /// config. Returns the manifests, with the digests of their revisions.
    pub(crate) fn check_manifests(
        &mut self,
        store: &RevisionStore,
    ) -> Result<Vec<(Sha256, Manifest)>, Failure> {
        let wish = self.deployment.payload();
        let overrides = overrides(wish);
        let mut manifests = Vec::new();
        for digest in self.revisions().map(Trusted::digest) {
            let manifest = Manifest::load(BuildDir::of(store.folder(digest)).path())?;
            check_grants(wish, &manifest)?;
            let set = match manifests.is_empty() {
                true => overrides.clone(),
                false => known(&overrides, &manifest),
            };
            ConfigSet::resolve(&manifest, &set).map_err(|error| {
                Failure::because("the config of the deployment does not fit", &error)
            })?;
            manifests.push((digest.clone(), manifest));
        }
        if let Some((_, manifest)) = manifests.get(1) {
            self.fallback_set = known(&overrides, manifest);
        }
        Ok(manifests)
    }

    /// Returns what runs by it, if `deployed` is its state.
    pub(crate) fn desired(&self, deployed: &Deployed, store: &RevisionStore) -> DesiredLambda {
        let wish = self.deployment.payload();
        let fallback = self.fallback.as_ref().filter(|_| deployed.runs_fallback);
        let revision = fallback.unwrap_or(&self.revision);
        let overrides = match fallback {
            Some(_) => self.fallback_set.clone(),
            None => overrides(wish),
        };
        DesiredLambda {
            id: wish.id.to_string(),
            name: revision.payload().name.to_string(),
            revision: revision.digest().to_string(),
            folder: store.folder(revision.digest()),
            envelope: store.envelope_path(revision.digest()),
            set: overrides.iter().map(|(name, value)| format!("{name}={value}")).collect(),
            attempt: deployed.attempt,
        }
    }

    /// Returns its status, without that of its lambda.
    /// `stale` is the reason if its end is over.
    pub(crate) fn status(&self, deployed: &Deployed, stale: Option<Refusal>) -> DeploymentStatus {
        let Deployment { grants, .. } = self.deployment.payload();
        DeploymentStatus {
            config: overrides(self.deployment.payload()).into_iter().collect(),
            revision: revision_status(&self.revision),
            fallback: self.fallback.as_ref().map(revision_status),
            grants: GrantStatus {
                topics: grants.topics.iter().map(ToString::to_string).collect(),
                models: grants.models.iter().map(ToString::to_string).collect(),
                record: grants.record,
            },
            stale: stale.map(|refusal| refusal.to_string()),
            ..deployed.status(self.id(), &self.envelope)
        }
    }
}

fn revision_status(revision: &Trusted<Revision>) -> RevisionStatus {
    let Revision { version, release, .. } = revision.payload();
    let (digest, version) = (revision.digest().to_string(), version.to_string());
    RevisionStatus { digest, version, release: *release }
}

fn overrides(wish: &Deployment) -> Vec<(String, String)> {
    wish.config.iter().map(|(name, value)| (name.to_string(), value.to_string())).collect()
}

/// Returns the overrides of items that the manifest has: an older revision may lack some.
fn known(overrides: &[(String, String)], manifest: &Manifest) -> Vec<(String, String)> {
    let has = |name: &String| manifest.config.iter().any(|item| item.name == name.as_str());
    overrides.iter().filter(|(name, _)| has(name)).cloned().collect()
}

/// Checks that the deployment grants everything that the manifest asks for.
fn check_grants(wish: &Deployment, manifest: &Manifest) -> Result<(), Failure> {
    let inputs = manifest.inputs.iter().map(|input| &input.topic);
    let topics = inputs.chain(manifest.record.iter().flat_map(|record| &record.topics));
    let topics = topics.filter(|topic| !wish.grants.topics.contains(topic));
    let models = manifest.models.iter().map(|model| &model.name);
    let models = models.filter(|model| !wish.grants.models.contains(model));
    let recording = manifest.record.iter().filter(|_| !wish.grants.record);
    let mut lacks: Vec<_> = topics.map(|topic| format!("topic {topic}")).collect();
    lacks.extend(models.map(|model| format!("model {model}")));
    lacks.extend(recording.map(|_| "recording".to_owned()));
    if lacks.is_empty() {
        return Ok(());
    }
    lacks.sort();
    lacks.dedup();
    let (name, version) = (&manifest.lambda.name, &manifest.lambda.version);
    let lacks = list(&lacks, "and");
    let message = format!("deployment `{}` does not grant {lacks}", wish.id);
    let mut failure = Failure::new(Exit::Denied, message);
    failure.causes = vec![format!("`{name}` {version} asks for it in its lambda.toml")];
    Err(failure.with_help("sign a deployment that grants it, or change the lambda"))
}
