//! Vehicles and their records.

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, NoContent, Response};
use gleaner_fleet::Enrolment;
use gleaner_fleet::people::{ListPage, NewVehicle, Role, VehicleSummary};
use gleaner_fleet::records::FoundRecords;
use gleaner_protocol::vehicle_api::{StreamLine, VehicleStatus};

use super::conditions::created;
use super::records::{self, RecordQuery};
use super::{Actor, ApiRow, CREATES, DELETE, GET, ListPart, POST, RESUMES, row};
use crate::cloud::{Call, Services};
use crate::error::{CloudResult, JsonResult};
use crate::records::RecordSearch;
use crate::request::ListQuery;

pub(super) fn endpoints() -> Vec<ApiRow> {
    use Role::{Admin, Viewer};
    let agrees = "Lets a vehicle follow a state that is older than it has followed";
    let of_lambda = "/v1/vehicles/{name}/lambdas/{id}/records";
    let lines = |path, summary| {
        let lines = row(GET, path, Viewer, summary, records::lines).query::<RecordQuery>();
        lines.headers(RESUMES).gives_lines::<StreamLine>()
    };
    vec![
        row(GET, "/v1/vehicles", Viewer, "All vehicles", list)
            .query::<ListQuery<String>>()
            .gives::<ListPage<VehicleSummary>>(),
        row(POST, "/v1/vehicles", Admin, "Invites a vehicle, or one again", invite)
            .headers(CREATES)
            .takes::<NewVehicle>()
            .gives::<Enrolment>(),
        row(DELETE, "/v1/vehicles/{name}", Admin, "Cuts a vehicle off", revoke),
        row(POST, "/v1/vehicles/{name}/agree", Admin, agrees, agree),
        row(GET, "/v1/vehicles/{name}/status", Viewer, "The last report of a vehicle", status)
            .gives::<VehicleStatus>(),
        lines("/v1/vehicles/{name}/events", "Events of a vehicle"),
        lines(of_lambda, "Records of a deployment on a vehicle"),
        row(GET, "/v1/records", Viewer, "Searches records of all vehicles", search)
            .query::<RecordSearch>()
            .gives::<FoundRecords>(),
    ]
}

async fn list(
    State(cloud): Services,
    Query(part): ListPart,
) -> JsonResult<ListPage<VehicleSummary>> {
    let vehicles = cloud.store.vehicles(part.after(), part.limit.into()).await?;
    Ok(Json(ListPage::of(vehicles, part.limit.into(), |vehicle| vehicle.name.clone())))
}

async fn invite(
    Call(cloud, actor): Actor,
    headers: HeaderMap,
    body: Bytes,
) -> JsonResult<Enrolment> {
    let body = (&body, "enrolment of a vehicle");
    let (conditions, NewVehicle { name }) = created(&headers, "/v1/vehicles", body)?;
    cloud.enrolments.invite(conditions.by(&actor), &name).await.map(Json)
}

async fn revoke(Call(cloud, actor): Actor, Path(name): Path<String>) -> CloudResult<NoContent> {
    cloud.enrolments.revoke(&actor.actor, &name).await.map(|()| NoContent)
}

async fn agree(Call(cloud, actor): Actor, Path(name): Path<String>) -> CloudResult<NoContent> {
    cloud.enrolments.agree(&actor.actor, &name).await.map(|()| NoContent)
}

async fn status(State(cloud): Services, Path(name): Path<String>) -> CloudResult<Response> {
    let status = cloud.store.status(&name).await?;
    cloud.live_streams.watch(&name);
    Ok(([(header::CONTENT_TYPE, "application/json")], status).into_response())
}

async fn search(
    Call(cloud, user): Actor,
    Query(search): Query<RecordSearch>,
) -> JsonResult<FoundRecords> {
    // It takes memory and time: as many at a time as streams.
    let _slot = cloud.readers.open(&user.user.name)?;
    cloud.records.search(&search).await.map(Json)
}
