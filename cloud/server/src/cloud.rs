//! The state that the handlers of both listeners share.

use std::sync::Arc;

use tokio::sync::Semaphore;

use crate::attempts::WrongSecrets;
use crate::authority::Authorities;
use crate::clips::ClipFiles;
use crate::hub::Hub;
use crate::objects::Objects;
use crate::store::{CloudStore, Retention};

/// Maximum number of streams of records that people read at a time.
pub(crate) const READERS_MAX: usize = 64;

/// The state of the server.
pub(crate) struct Cloud {
    pub(crate) store: CloudStore,
    pub(crate) objects: Objects,
    pub(crate) clips: ClipFiles,
    pub(crate) hub: Hub,
    pub(crate) authorities: Authorities,
    pub(crate) wrong_secrets: WrongSecrets,
    pub(crate) readers: Arc<Semaphore>,
    pub(crate) retention: Retention,
    /// Address for vehicles, as enrolments state it.
    pub(crate) address: String,
}
