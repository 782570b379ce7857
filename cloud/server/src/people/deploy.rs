//! Receives deployments and their files.

use std::collections::BTreeMap;
use std::sync::Arc;

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use gleaner_base::Failure;
use gleaner_fleet::people::{FleetDeployRequest, ReportedRelease};
use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::vehicle_api::{
    DeployReply, DeploymentEnvelopes, GrantStatus, RevisionEnvelope,
};
use gleaner_trust::{Refusal, Revision, unverified_deployment, unverified_revision};

use super::conditions::ChangeConditions;
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult};
use crate::request::{digest, parsed};
use crate::store::{OfferedDeployment, TokenUser};
use crate::transfer::skip;

/// Maximum number of reported releases that are listed.
const REPORTED_MAX: i64 = 100;

/// Stores a deployment, or answers with the files that are missing for it.
pub(super) async fn deploy(
    Call(cloud, actor): Call<TokenUser>,
    headers: HeaderMap,
    body: Bytes,
) -> CloudResult<Json<DeployReply>> {
    let conditions = ChangeConditions::of_new(&headers, "/v1/deployments", &body)?;
    let request: FleetDeployRequest = parsed(&body, "deployment")?;
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
    let named: Vec<&Sha256> =
        [Some(&deployment.revision), deployment.fallback.as_ref()].into_iter().flatten().collect();
    let mut revisions: Vec<Revision> = Vec::new();
    let mut envelopes = BTreeMap::new();
    for digest in named {
        let (revision, envelope) = match sent.remove(digest) {
            Some(sent) => sent,
            None => stored(&cloud, digest).await?,
        };
        revisions.push(revision);
        envelopes.insert(digest.to_string(), envelope);
    }
    let id = deployment.id.to_string();
    // What is not missing now is not removed until the deployment needs it.
    let _uses = cloud.objects.uses.read().await;
    let objects = cloud.objects.missing(&revisions).await?;
    cloud.store.await_files(&id, &objects).await?;
    if !objects.is_empty() {
        return Ok(Json(DeployReply::Missing { objects }));
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
    let (generation, changed) = cloud.store.deploy(conditions.by(&actor), &offered).await?;
    cloud.hub.wake(&changed);
    Ok(Json(DeployReply::Accepted { id, attempt: 0, generation }))
}

/// Returns the signed parts of a deployment, for those who sign the next one.
pub(super) async fn envelopes(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
) -> CloudResult<Json<DeploymentEnvelopes>> {
    let deployment = cloud.store.newest_envelope(&id).await?;
    let wish = unverified_deployment(deployment.as_bytes())
        .map_err(|error| Failure::because("the stored deployment is damaged", &error))?;
    let mut revisions = Vec::new();
    for digest in std::iter::once(&wish.revision).chain(&wish.fallback) {
        let (revision, envelope) = stored(&cloud, digest).await?;
        let manifest = cloud.objects.manifest(&revision).await?;
        revisions.push(RevisionEnvelope { envelope, manifest });
    }
    Ok(Json(DeploymentEnvelopes { deployment, revisions }))
}

pub(super) async fn reported(
    State(cloud): State<Arc<Cloud>>,
    Path(id): Path<String>,
) -> CloudResult<Json<Vec<ReportedRelease>>> {
    cloud.store.reported_releases(&id, REPORTED_MAX).await.map(Json)
}

async fn stored(cloud: &Cloud, digest: &Sha256) -> CloudResult<(Revision, String)> {
    let missing = || {
        let message = format!("the deployment names revision {digest}, which was not sent");
        CloudError::usage(message, "send its file, too, as the revision or the fallback")
    };
    let envelope = cloud.store.revision(digest.as_str()).await?.ok_or_else(missing)?;
    let parsed = unverified_revision(envelope.as_bytes());
    let (revision, _) =
        parsed.map_err(|error| Failure::because("a stored revision is damaged", &error))?;
    Ok((revision, envelope))
}

/// Receives a file that a deployment needs.
pub(super) async fn object(
    Call(cloud, user): Call<TokenUser>,
    Path(sha256): Path<String>,
    body: Body,
) -> CloudResult<StatusCode> {
    let slot = cloud.transfers.open(&user.user.name);
    if let Err(busy) = slot {
        skip(body).await;
        return Err(busy);
    }
    cloud.objects.receive(&cloud.store, &digest(&sha256)?, body).await?;
    Ok(StatusCode::NO_CONTENT)
}
