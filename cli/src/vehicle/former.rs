//! The deployment that another one replaces, as its deployer signed it. Nothing else of a vehicle
//! or a cloud becomes a part of the next signature.

use std::collections::BTreeMap;

use gleaner_base::{Exit, Failure, visible};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{ConfigValue, ItemName, LambdaName, MANIFEST_FILE, Sha256};
use gleaner_protocol::vehicle_api::{DeploymentEnvelopes, RevisionEnvelope};
use gleaner_trust::{
    Deployment, Floors, Grants, PublicKey, Revision, SecretKey, deployment_of_keys, first_root,
    revision_of_digest, sha256,
};

use super::client::VehicleClient;
use super::deploy::path;
use super::trust::read;
use crate::args::DeployArgs;

/// A deployment that was verified by the keys of deployers.
pub(crate) struct Former {
    pub(crate) deployment: Deployment,
    /// Its revision, and then its fallback.
    revisions: Vec<FormerRevision>,
}

/// A revision of such a deployment, with the manifest that its digest covers.
pub(crate) struct FormerRevision {
    digest: Sha256,
    revision: Revision,
    manifest: Manifest,
}

/// The fallback of a new deployment.
#[derive(Clone, Copy)]
pub(crate) struct Fallback<'f> {
    pub(crate) digest: &'f Sha256,
    /// Absent of one that the former deployment does not have.
    known: Option<&'f FormerRevision>,
}

impl Former {
    /// Fetches the deployment `id`, and verifies it by the key of the next one, and by the keys of
    /// the deployers of `--trust`. Returns `None` if it cannot be verified, and the options choose
    /// everything that it would.
    ///
    /// # Errors
    ///
    /// A failure if it is not signed by one of these keys, or what belongs to it is not signed.
    pub(crate) fn fetch(
        client: &VehicleClient,
        args: &DeployArgs,
        key: &SecretKey,
        (id, lambda): (&str, &LambdaName),
    ) -> Result<Option<Self>, Failure> {
        let mut keys = vec![key.public()];
        if let Some(file) = &args.trust {
            keys.extend(deployers(file)?);
        }
        let parts = client.get::<DeploymentEnvelopes>(&format!("{}/envelopes", path(id)?));
        match parts.and_then(|parts| Self::verify(&parts, &keys, (id, lambda))) {
            Err(_) if args.fallback.is_some() && args.release.is_some() => Ok(None),
            Err(failure) => Err(failure.with_help(
                "name the trust root that has the key of its deployer: `--trust FILE`; or choose \
                 what would follow from it: `--release N --fallback none`, or a digest",
            )),
            Ok(former) => Ok(Some(former)),
        }
    }

    fn verify(
        parts: &DeploymentEnvelopes,
        keys: &[PublicKey],
        (id, lambda): (&str, &LambdaName),
    ) -> Result<Self, Failure> {
        let refused = |refusal| {
            Failure::because("the deployment before this one cannot be verified", &refusal)
        };
        let deployment = deployment_of_keys(parts.deployment.as_bytes(), keys).map_err(refused)?;
        // Another one of the same deployer must not stand for it.
        let other = |what: &str, found: &str| {
            let message = format!("the deployment before this one is of another {what}: `{found}`");
            Failure::new(Exit::Denied, message)
        };
        if deployment.id.as_str() != id {
            return Err(other("id", deployment.id.as_str()));
        }
        let named = std::iter::once(&deployment.revision).chain(&deployment.fallback);
        let mut revisions = Vec::new();
        for (index, digest) in named.enumerate() {
            let lacks =
                || Failure::new(Exit::Denied, format!("the revision {digest} was not sent"));
            let RevisionEnvelope { envelope, manifest } =
                parts.revisions.get(index).ok_or_else(lacks)?;
            let revision = revision_of_digest(envelope.as_bytes(), digest).map_err(refused)?;
            let file = revision.files.iter().find(|file| file.path.as_str() == MANIFEST_FILE);
            if file.is_none_or(|file| file.sha256 != sha256(manifest.as_bytes())) {
                let message = format!("another manifest than that of revision {digest} was sent");
                return Err(Failure::new(Exit::Denied, message));
            }
            if revision.name != *lambda {
                return Err(other("lambda", revision.name.as_str()));
            }
            let manifest = Manifest::parse(manifest, MANIFEST_FILE)?;
            revisions.push(FormerRevision { digest: digest.clone(), revision, manifest });
        }
        Ok(Self { deployment, revisions })
    }

    /// Returns the fallback of the next deployment: its revision, or its fallback if that has
    /// `failed` on a vehicle; none without one if it has failed on `all`.
    fn runs(&self, (failed, all): (u64, u64)) -> Option<Fallback<'_>> {
        let fallback = self.revisions.get(1).filter(|_| failed > 0);
        let revision = self.revisions.first().filter(|_| failed == 0 || failed < all);
        let runs = fallback.or(revision)?;
        Some(Fallback { digest: &runs.digest, known: Some(runs) })
    }

    pub(crate) fn revision(&self) -> Option<&Revision> {
        self.revisions.first().map(|it| &it.revision)
    }

    fn find(&self, digest: &Sha256) -> Option<&FormerRevision> {
        self.revisions.iter().find(|it| it.digest == *digest)
    }
}

impl<'f> Fallback<'f> {
    /// Returns the fallback that the options choose: `named`, or what runs by the former
    /// deployment. It is never the revision `digest` itself.
    pub(crate) fn choose(
        args: &DeployArgs,
        named: Option<&'f Sha256>,
        (former, failed): (Option<&'f Former>, (u64, u64)),
        digest: &Sha256,
    ) -> Option<Self> {
        let chosen = match (args.fallback.as_deref(), named) {
            (Some("none"), _) => None,
            (_, Some(digest)) => {
                let known = former.and_then(|former| former.find(digest));
                Some(Self { digest, known })
            }
            (_, None) => former.and_then(|former| {
                let runs = former.runs(failed).filter(|it| it.digest != digest);
                // Of the same revision, such as with another config, the fallback stays.
                let own = former.revisions.get(1);
                runs.or_else(|| own.map(|it| Self { digest: &it.digest, known: Some(it) }))
            }),
        };
        chosen.filter(|chosen| chosen.digest != digest)
    }

    pub(crate) fn manifest(&self) -> Option<&'f Manifest> {
        self.known.map(|known| &known.manifest)
    }

    fn describe(self) -> String {
        match self.known {
            Some(FormerRevision { revision: Revision { name, version, release, .. }, .. }) => {
                format!("{name} {version} (release {release})")
            }
            None => format!("{} (not known here: it gets no grants of its own)", self.digest),
        }
    }
}

/// Returns the lines about a deployment before it is signed: its fallback, and what differs from
/// the former one.
pub(crate) fn changes(
    deployment: &Deployment,
    former: Option<&Former>,
    fallback: Option<Fallback<'_>>,
) -> Vec<String> {
    let fallback = fallback.map_or_else(|| "none".to_owned(), Fallback::describe);
    let mut lines = vec![format!("fallback: {fallback}")];
    let (empty, none) = (Grants::default(), BTreeMap::new());
    let (granted, config) = former
        .map_or((&empty, &none), |former| (&former.deployment.grants, &former.deployment.config));
    let [before, after] = [granted, &deployment.grants].map(rights);
    let lacking = |all: &[String], others: &[String]| {
        all.iter().filter(|it| !others.contains(it)).cloned().collect::<Vec<_>>().join(", ")
    };
    for (what, rights) in
        [("grants", lacking(&after, &before)), ("grants no longer", lacking(&before, &after))]
    {
        if !rights.is_empty() {
            lines.push(format!("{what}: {rights}"));
        }
    }
    lines.extend(config_changes(config, &deployment.config));
    lines
}

fn config_changes(
    before: &BTreeMap<ItemName, ConfigValue>,
    after: &BTreeMap<ItemName, ConfigValue>,
) -> Vec<String> {
    let text = |value: Option<&ConfigValue>| {
        value.map_or_else(|| "as in the manifest".to_owned(), |it| visible(&it.to_string()))
    };
    let names: std::collections::BTreeSet<_> = before.keys().chain(after.keys()).collect();
    let changed = names.into_iter().filter(|name| before.get(*name) != after.get(*name));
    let line = |name: &ItemName| {
        format!("config {name}: {}, before {}", text(after.get(name)), text(before.get(name)))
    };
    changed.map(line).collect()
}

fn rights(grants: &Grants) -> Vec<String> {
    let topics = grants.topics.iter().map(|topic| format!("topic {topic}"));
    let models = grants.models.iter().map(|model| format!("model {model}"));
    let record = grants.record.then(|| "recording".to_owned());
    topics.chain(models).chain(record).collect()
}

/// Returns the keys of the deployers of a trust root.
fn deployers(file: &std::path::Path) -> Result<Vec<PublicKey>, Failure> {
    let root = first_root(&read(file)?, &Floors::default()).map_err(|refusal| {
        Failure::because(format!("cannot use `{}`", file.display()), &refusal)
    })?;
    Ok(root.deployers.into_iter().map(|scoped| scoped.key).collect())
}
