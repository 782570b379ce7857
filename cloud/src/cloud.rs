//! The services of the server, and its bounds, as the doors use them.

use std::sync::Arc;

use axum::extract::rejection::ExtensionRejection;
use axum::extract::{Extension, FromRequestParts, State};
use axum::http::request::Parts;
use gleaner_base::Failure;
use tokio::sync::Mutex;
use tokio::time::Instant;

use crate::accounts::Accounts;
use crate::attempts::VehicleLimits;
use crate::authority::Authorities;
use crate::clips::{ClipFiles, FleetClips};
use crate::deployments::Deployments;
use crate::enrolments::Enrolments;
use crate::folder::DataFolder;
use crate::hub::Hub;
use crate::live_streams::LiveStreams;
use crate::objects::Objects;
use crate::place::FilePlace;
use crate::readers::Readers;
use crate::records::{ChunkFiles, RecordArchive};
use crate::scaled::S3Bucket;
use crate::store::{ClipBounds, CloudStore};

/// Descriptors that connections and files leave to the database, the log and short reads.
const DESCRIPTORS_KEPT: usize = 64;

/// The services, and what they share. Doors read lists from the store themselves; each change with
/// a rule, or that others have to learn of, is one of a service.
pub(crate) struct Cloud {
    pub(crate) store: Arc<CloudStore>,
    pub(crate) hub: Arc<Hub>,
    pub(crate) objects: Arc<Objects>,
    pub(crate) accounts: Accounts,
    pub(crate) enrolments: Enrolments,
    pub(crate) deployments: Deployments,
    pub(crate) clips: FleetClips,
    pub(crate) records: RecordArchive,
    pub(crate) live_streams: Arc<LiveStreams>,
    pub(crate) limits: VehicleLimits,
    pub(crate) readers: Arc<Readers>,
    /// Pages that are read whole, apart from streams, which last.
    pub(crate) page_readers: Arc<Readers>,
    /// Files that are sent and received, with a descriptor each.
    pub(crate) transfers: Arc<Readers>,
    /// Time of the last look at the database for `/health`, and its version then.
    pub(crate) health: Mutex<Option<(Instant, i64)>>,
}

impl Cloud {
    /// Opens the files in the folder or the bucket.
    /// Fails if a folder of files cannot be used.
    pub(crate) fn open(
        (store, hub): (Arc<CloudStore>, Hub),
        (folder, bucket): (&DataFolder, Option<&S3Bucket>),
        authorities: (Authorities, String),
        keep_records_days: u32,
    ) -> Result<Arc<Self>, Failure> {
        let place = |folder, start| FilePlace::open(folder, bucket, start);
        let (hub, readers) = (Arc::new(hub), Readers::new("streams of records"));
        let objects = Arc::new(Objects::new(place(folder.objects(), "objects/")?));
        let clips = ClipFiles::new(place(folder.clips(), "clips/")?, ClipBounds::DEFAULT);
        let chunks = ChunkFiles::new(place(folder.records(), "records/")?);
        Ok(Arc::new(Self {
            accounts: Accounts::new(&store, &readers),
            enrolments: Enrolments::new(&store, &hub, authorities),
            deployments: Deployments::new(&store, &hub, &objects),
            clips: FleetClips::new(&store, &hub, clips),
            records: RecordArchive::new(&store, chunks, keep_records_days),
            store,
            hub,
            objects,
            live_streams: Arc::default(),
            limits: VehicleLimits::default(),
            readers,
            page_readers: Readers::new("pages of records"),
            transfers: Readers::bounded("transfers of files", descriptors(1)),
            health: Mutex::default(),
        }))
    }

    #[cfg(test)]
    pub(crate) async fn of_test() -> (tempfile::TempDir, Arc<Self>) {
        let folder = tempfile::TempDir::new().unwrap();
        let data = DataFolder::create(&folder.path().join("data")).unwrap();
        let store = (Arc::new(CloudStore::of_test(&folder).await), Hub::default());
        let authorities = (Authorities::open(&data).unwrap(), "127.0.0.1:8443".to_owned());
        let cloud = Self::open(store, (&data, None), authorities, 30).unwrap();
        (folder, cloud)
    }
}

/// Returns so many sixteenths of the descriptors for connections and files, which take 15 of them:
/// without the others, no record could be stored.
pub(crate) fn descriptors(sixteenths: usize) -> usize {
    gleaner_base::open_files_max().saturating_sub(DESCRIPTORS_KEPT) / 16 * sixteenths
}

/// The services, for a request that needs no caller.
pub(crate) type Services = State<Arc<Cloud>>;

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
