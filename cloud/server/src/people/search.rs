//! The search for records.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Query, State};
use gleaner_fleet::records::FoundRecords;

use crate::cloud::Cloud;
use crate::error::CloudResult;
use crate::records::RecordSearch;
use crate::store::TokenUser;

pub(super) async fn records(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<TokenUser>,
    Query(search): Query<RecordSearch>,
) -> CloudResult<Json<FoundRecords>> {
    // It takes memory and time: as many at a time as streams.
    let _slot = cloud.readers.open(&user.user.name)?;
    Ok(Json(cloud.search(&search).await?))
}
