//! Lists that can grow, part by part: `?after=CURSOR&limit=N`.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Query, State};
use axum::http::HeaderMap;
use axum::response::Response;
use gleaner_fleet::people::{AuditEntry, FleetDeployment, ListPage, User, VehicleSummary};
use gleaner_fleet::records::FoundRecords;

use super::conditions::tagged;
use crate::cloud::{Call, Cloud};
use crate::error::CloudResult;
use crate::records::RecordSearch;
use crate::request::ListQuery;
use crate::store::TokenUser;

pub(super) async fn users(
    State(cloud): State<Arc<Cloud>>,
    Query(part): Query<ListQuery<String>>,
) -> CloudResult<Json<ListPage<User>>> {
    let after = part.after.unwrap_or_default();
    let users = cloud.store.users(&after, part.limit.into()).await?;
    Ok(Json(ListPage::of(users, part.limit.into(), |user| user.name.clone())))
}

pub(super) async fn vehicles(
    State(cloud): State<Arc<Cloud>>,
    Query(part): Query<ListQuery<String>>,
) -> CloudResult<Json<ListPage<VehicleSummary>>> {
    let after = part.after.unwrap_or_default();
    let vehicles = cloud.store.vehicles(&after, part.limit.into()).await?;
    Ok(Json(ListPage::of(vehicles, part.limit.into(), |vehicle| vehicle.name.clone())))
}

pub(super) async fn deployments(
    State(cloud): State<Arc<Cloud>>,
    Query(part): Query<ListQuery<String>>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let after = part.after.unwrap_or_default();
    let deployments = cloud.store.deployments(&after, part.limit.into()).await?;
    let page = ListPage::of(deployments, part.limit.into(), |it: &FleetDeployment| it.id.clone());
    tagged(&headers, "", &page)
}

/// Returns entries of the audit trail, the newest first.
pub(super) async fn audit(
    State(cloud): State<Arc<Cloud>>,
    Query(part): Query<ListQuery<u64>>,
) -> CloudResult<Json<ListPage<AuditEntry>>> {
    let before = part.after.unwrap_or(u64::MAX);
    let entries = cloud.store.audit(before, part.limit.into()).await?;
    Ok(Json(ListPage::of(entries, part.limit.into(), |entry| entry.seq.to_string())))
}

pub(super) async fn records(
    Call(cloud, user): Call<TokenUser>,
    Query(search): Query<RecordSearch>,
) -> CloudResult<Json<FoundRecords>> {
    // It takes memory and time: as many at a time as streams.
    let _slot = cloud.readers.open(&user.user.name)?;
    Ok(Json(cloud.search(&search).await?))
}
