//! The state that the handlers of both listeners share.

use std::sync::Arc;

use axum::extract::rejection::ExtensionRejection;
use axum::extract::{Extension, FromRequestParts};
use axum::http::request::Parts;
use tokio::sync::{Mutex, Semaphore};
use tokio::time::Instant;

use crate::attempts::{AccountChanges, VehicleLimits, WrongSecrets};
use crate::authority::Authorities;
use crate::clips::ClipFiles;
use crate::hub::Hub;
use crate::objects::Objects;
use crate::readers::Readers;
use crate::records::ChunkFiles;
use crate::store::{CloudStore, Retention};
use crate::tails::Tails;

/// Maximum number of frames of vehicles that are parsed and stored at a time: each may have 8 MiB.
pub(crate) const STORED_FRAMES_MAX: usize = 64;

/// The state of the server.
pub(crate) struct Cloud {
    pub(crate) store: CloudStore,
    pub(crate) objects: Objects,
    pub(crate) clips: Arc<ClipFiles>,
    pub(crate) chunks: ChunkFiles,
    pub(crate) hub: Hub,
    pub(crate) authorities: Authorities,
    pub(crate) wrong_secrets: WrongSecrets,
    pub(crate) limits: VehicleLimits,
    pub(crate) account_changes: AccountChanges,
    pub(crate) readers: Arc<Readers>,
    /// Pages that are read whole, apart from streams, which last.
    pub(crate) page_readers: Arc<Readers>,
    /// Files that are sent and received, with a descriptor each.
    pub(crate) transfers: Arc<Readers>,
    pub(crate) tails: Arc<Tails>,
    /// Frames of vehicles that are parsed and stored at a time.
    pub(crate) stored_frames: Semaphore,
    pub(crate) retention: Retention,
    /// Time of the last look at the database for `/health`, and its version then.
    pub(crate) health: Mutex<Option<(Instant, i64)>>,
    /// Days for which records are kept at least; 0 is without an end.
    pub(crate) keep_records_days: u32,
    /// Address for vehicles, as enrolments state it.
    pub(crate) address: String,
}

/// A request that a guard has let pass: the state of the server, and the user or the vehicle.
pub(crate) struct Call<C>(pub(crate) Arc<Cloud>, pub(crate) C);

impl<C: Clone + Send + Sync + 'static> FromRequestParts<Arc<Cloud>> for Call<C> {
    type Rejection = ExtensionRejection;

    async fn from_request_parts(
        parts: &mut Parts,
        cloud: &Arc<Cloud>,
    ) -> Result<Self, Self::Rejection> {
        let Extension(caller) = Extension::<C>::from_request_parts(parts, cloud).await?;
        Ok(Self(Arc::clone(cloud), caller))
    }
}
