//! The connection of the vehicle to the cloud.
//!
//! - `settings`: address, authority, key and certificate of an enrolled vehicle.
//! - `http`: HTTPS to the cloud. `enrolling`: gets the first certificate, and later ones.
//! - `link`: keeps a connection, and `session` exchanges frames over one. `network` notices another
//!   way to the cloud.
//! - `plan`: the steps from what runs to what the cloud wants; `reconcile` takes them.
//!   `followed` remembers which state of the cloud that was.
//! - `download`: fetches a file of a revision, and goes on where that was interrupted.
//! - `uplink`: sends records that the cloud does not have, `resume` finds where to go on, and
//!   `collect` decides which of them are sent at once.
//! - `clips`: announces clips, and sends those that the cloud wants; `clip_list` reads them.
//! - `fake_cloud`: for tests, a cloud over TLS that answers as a test wants.
//!
//! Without a connection everything runs on, and records wait in their spools. What the cloud wants
//! is verified as a deployment by a user is: it can run nothing that no trusted key has signed.

mod clip_list;
mod clips;
mod collect;
mod download;
mod enrolling;
#[cfg(test)]
mod fake_cloud;
mod followed;
mod http;
mod link;
mod network;
mod plan;
mod reconcile;
mod resume;
mod session;
mod settings;
#[cfg(test)]
mod tests;
mod uplink;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use gleaner_base::{Exit, Failure, visible};
use gleaner_protocol::vehicle_api::{CloudStatus, FailingStreams, VehicleStatus};
use tokio::sync::watch;

use crate::durable::DurableFile;
use crate::spools::SpoolCounts;
use clips::ClipTracker;
use http::BusyWait;
use settings::CloudSettings;
use uplink::FailedTry;

pub(crate) use link::CloudLink;

/// The enrolment and the state of the connection, shared by the API and the link.
#[derive(Clone)]
pub(crate) struct Cloud {
    shared: Arc<Mutex<LinkView>>,
    settings: watch::Sender<Option<CloudSettings>>,
    file: Arc<DurableFile>,
    /// The clips on their way, across connections.
    clips: Arc<Mutex<ClipTracker>>,
    /// The wait for a busy cloud, across connections.
    wait: Arc<Mutex<Option<BusyWait>>>,
}

/// The connection, as users see it.
struct LinkView {
    state: LinkState,
    reason: Option<String>,
    help: Option<String>,
    since: Instant,
    generation: u64,
    counts: SpoolCounts,
    failing: BTreeMap<String, FailedTry>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LinkState {
    Connecting,
    Connected,
    Refused,
}

impl LinkState {
    fn as_str(self) -> &'static str {
        match self {
            LinkState::Connecting => "connecting",
            LinkState::Connected => "connected",
            LinkState::Refused => "refused",
        }
    }
}

impl Cloud {
    /// Loads the enrolment. Also returns a warning if its file, or one of its copies, is damaged.
    pub(crate) fn load(file: DurableFile) -> (Self, Option<String>) {
        let (settings, damage) = match file.load::<CloudSettings>() {
            Ok(loaded) => (loaded.value, loaded.damage),
            Err(failure) => (None, Some(failure.to_string())),
        };
        let shared = LinkView {
            state: LinkState::Connecting,
            reason: None,
            help: None,
            since: Instant::now(),
            generation: 0,
            // Until they are counted.
            counts: SpoolCounts { uncounted: 1, ..SpoolCounts::default() },
            failing: BTreeMap::new(),
        };
        let cloud = Self {
            shared: Arc::new(Mutex::new(shared)),
            settings: watch::Sender::new(settings),
            file: Arc::new(file),
            clips: Arc::default(),
            wait: Arc::default(),
        };
        (cloud, damage)
    }

    /// Returns the state of the connection; `None` unless the vehicle is enrolled.
    pub(crate) fn status(&self) -> Option<CloudStatus> {
        let settings = self.settings.borrow().clone()?;
        let clips = self.clips.lock().unwrap_or_else(PoisonError::into_inner).status();
        let wait = self.wait.lock().unwrap_or_else(PoisonError::into_inner);
        let is_now =
            |wait: &&BusyWait| wait.address == settings.address && Instant::now() < wait.until;
        let wait = wait.as_ref().filter(is_now);
        let shared = self.lock();
        Some(CloudStatus {
            address: settings.address,
            state: shared.state.as_str().to_owned(),
            reason: shared.reason.clone().or_else(|| Some(wait?.reason.clone())),
            help: shared.help.clone(),
            since_s: shared.since.elapsed().as_secs_f64(),
            generation: shared.generation,
            unsent: shared.counts.unsent,
            uncounted: shared.counts.uncounted,
            failing: shared.failing(),
            certificate_expires: settings.expires,
            clips,
        })
    }

    /// Ends the enrolment: the vehicle does not connect any more. What runs goes on.
    pub(crate) fn leave(&self) -> Result<(), Failure> {
        if self.settings.borrow().is_none() {
            return Err(Failure::new(Exit::Usage, "this vehicle is not enrolled at a cloud"));
        }
        self.file.remove()?;
        self.settings.send_replace(None);
        Ok(())
    }

    /// Makes an enrolment durable, and lets the link use it.
    fn set(&self, settings: CloudSettings) -> Result<(), Failure> {
        self.file.save(&settings)?;
        self.settings.send_replace(Some(settings));
        // A refusal was one of the former settings.
        self.set_state(LinkState::Connecting, None, None);
        Ok(())
    }

    /// Notes the end of an attempt; returns whether it was connected.
    fn has_ended(&self) -> bool {
        let was_connected = self.lock().state == LinkState::Connected;
        if was_connected {
            self.set_state(LinkState::Connecting, None, None);
        }
        was_connected
    }

    /// Adds the state of the connection to that of the vehicle.
    pub(crate) fn add_to(&self, status: VehicleStatus) -> VehicleStatus {
        let records_lost = self.lock().counts.lost.clone();
        VehicleStatus { records_lost, cloud: self.status(), ..status }
    }

    fn set_failing(&self, failing: &BTreeMap<String, FailedTry>) {
        self.lock().failing.clone_from(failing);
    }

    fn set_state(&self, state: LinkState, reason: Option<String>, help: Option<String>) {
        let mut shared = self.lock();
        if shared.state != state {
            shared.since = Instant::now();
        }
        (shared.state, shared.reason, shared.help) = (state, reason, help);
    }

    fn lock(&self) -> MutexGuard<'_, LinkView> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LinkView {
    /// Returns the streams that fail, by cause.
    fn failing(&self) -> Vec<FailingStreams> {
        let mut causes: BTreeMap<&str, FailingStreams> = BTreeMap::new();
        for (name, it) in &self.failing {
            let (since_s, tried_s) = (it.since.elapsed().as_secs_f64(), it.tried.elapsed());
            let tried_s = tried_s.as_secs_f64();
            let new = || FailingStreams {
                cause: visible(&it.cause),
                streams: 0,
                example: visible(&format!("`{name}`: {}", it.text)),
                since_s,
                tried_s,
            };
            let of = causes.entry(&it.cause).or_insert_with(new);
            of.streams += 1;
            (of.since_s, of.tried_s) = (of.since_s.max(since_s), of.tried_s.min(tried_s));
        }
        causes.into_values().collect()
    }
}
