//! Deployments and their files.

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Path, Query, State};
use axum::handler::Handler;
use axum::http::HeaderMap;
use axum::response::{NoContent, Response};
use gleaner_fleet::people::{FleetDeployRequest, FleetDeployment, ListPage, ReportedRelease, Role};
use gleaner_protocol::vehicle_api::{DeployReply, DeploymentEnvelopes};

use super::conditions::{ChangeConditions, created, tagged};
use super::{
    Actor, ApiRow, BODY_MAX, CHANGES, CREATES, DELETE, GET, ListPart, POST, PUT, READS, row,
};
use crate::cloud::{Call, Services};
use crate::error::{CloudResult, JsonResult};
use crate::request::{ListQuery, digest};
use crate::transfer::skip;

/// Maximum number of reported releases that are listed.
const REPORTED_MAX: i64 = 100;

pub(super) fn endpoints() -> Vec<ApiRow> {
    use Role::{Deployer, Operator, Viewer};
    let deploy = deploy.layer(DefaultBodyLimit::max(BODY_MAX));
    let stores = "Stores a file that a deployment needs";
    let reports = "The highest releases of a deployment that vehicles have reported";
    let changes = "Changes a deployment: `start`, `stop`, `rollback`, `pause`, `resume` or `abort`";
    let parts = "/v1/deployments/{id}/envelopes";
    vec![
        row(PUT, "/v1/objects/{sha256}", Deployer, stores, object).takes_file(),
        row(POST, "/v1/deployments", Deployer, "Stores a deployment", deploy)
            .headers(CREATES)
            .takes::<FleetDeployRequest>()
            .gives::<DeployReply>(),
        row(GET, "/v1/deployments", Viewer, "All deployments", list)
            .query::<ListQuery<String>>()
            .headers(READS)
            .gives::<ListPage<FleetDeployment>>(),
        row(GET, "/v1/deployments/{id}", Viewer, "A deployment", show)
            .headers(READS)
            .gives::<FleetDeployment>(),
        row(GET, parts, Deployer, "The signed parts of a deployment", envelopes)
            .gives::<DeploymentEnvelopes>(),
        row(GET, "/v1/deployments/{id}/reported", Viewer, reports, reported)
            .gives::<Vec<ReportedRelease>>(),
        row(POST, "/v1/deployments/{id}/{change}", Operator, changes, change)
            .headers(CHANGES)
            .gives::<FleetDeployment>(),
        row(DELETE, "/v1/deployments/{id}", Deployer, "Removes a deployment", remove_one)
            .headers(CHANGES),
    ]
}

async fn deploy(
    Call(cloud, actor): Actor,
    headers: HeaderMap,
    body: Bytes,
) -> JsonResult<DeployReply> {
    let (conditions, new) = created(&headers, "/v1/deployments", (&body, "deployment"))?;
    cloud.deployments.deploy(conditions.by(&actor), new).await.map(Json)
}

async fn list(
    State(cloud): Services,
    Query(part): ListPart,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let deployments = cloud.store.deployments(part.after(), part.limit.into()).await?;
    let page = ListPage::of(deployments, part.limit.into(), |it| it.id.clone());
    tagged(&headers, "", &page)
}

async fn show(
    State(cloud): Services,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let deployment = cloud.store.deployment(&id).await?;
    tagged(&headers, &deployment.version, &deployment)
}

async fn envelopes(
    State(cloud): Services,
    Path(id): Path<String>,
) -> JsonResult<DeploymentEnvelopes> {
    cloud.deployments.envelopes(&id).await.map(Json)
}

async fn reported(
    State(cloud): Services,
    Path(id): Path<String>,
) -> JsonResult<Vec<ReportedRelease>> {
    cloud.store.reported_releases(&id, REPORTED_MAX).await.map(Json)
}

async fn change(
    Call(cloud, actor): Actor,
    Path((id, change)): Path<(String, String)>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let conditions = ChangeConditions::of_change(&headers)?;
    cloud.deployments.change(conditions.by(&actor), &id, &change).await?;
    show(State(cloud), Path(id), HeaderMap::new()).await
}

async fn remove_one(
    Call(cloud, actor): Actor,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> CloudResult<NoContent> {
    let conditions = ChangeConditions::of_change(&headers)?;
    cloud.deployments.remove(conditions.by(&actor), &id).await.map(|()| NoContent)
}

async fn object(
    Call(cloud, user): Actor,
    Path(sha256): Path<String>,
    body: Body,
) -> CloudResult<NoContent> {
    let slot = cloud.transfers.open(&user.user.name);
    if let Err(busy) = slot {
        skip(body).await;
        return Err(busy);
    }
    cloud.objects.receive(&cloud.store, &digest(&sha256)?, body).await.map(|()| NoContent)
}
