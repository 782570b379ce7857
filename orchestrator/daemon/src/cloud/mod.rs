//! The connection of the vehicle to the cloud.
//!
//! - `settings`: address, authority, key and certificate of an enrolled vehicle.
//! - `http`: HTTPS to the cloud. `enrolling`: gets the first certificate, and later ones.
//! - `link`: keeps a connection, and `session` exchanges frames over one.
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
mod plan;
mod reconcile;
mod resume;
mod session;
mod settings;
#[cfg(test)]
mod tests;
mod uplink;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use gleaner_base::{Exit, Failure, excerpt, visible};
use gleaner_protocol::vehicle_api::CloudStatus;
use tokio::sync::watch;

use crate::durable::DurableFile;
use settings::CloudSettings;

pub(crate) use link::CloudLink;

/// The enrolment and the state of the connection, shared by the API and the link.
#[derive(Clone)]
pub(crate) struct Cloud {
    shared: Arc<Mutex<LinkView>>,
    settings: watch::Sender<Option<CloudSettings>>,
    file: Arc<DurableFile>,
}

/// The connection, as users see it.
struct LinkView {
    state: LinkState,
    reason: Option<String>,
    help: Option<String>,
    since: Instant,
    generation: u64,
    unsent: u64,
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
            unsent: 0,
        };
        let cloud = Self {
            shared: Arc::new(Mutex::new(shared)),
            settings: watch::Sender::new(settings),
            file: Arc::new(file),
        };
        (cloud, damage)
    }

    /// Returns the state of the connection; `None` unless the vehicle is enrolled.
    pub(crate) fn status(&self) -> Option<CloudStatus> {
        let settings = self.settings.borrow().clone()?;
        let shared = self.lock();
        Some(CloudStatus {
            address: settings.address,
            state: shared.state.as_str().to_owned(),
            reason: shared.reason.clone(),
            help: shared.help.clone(),
            since_s: shared.since.elapsed().as_secs_f64(),
            generation: shared.generation,
            unsent: shared.unsent,
            certificate_expires: settings.expires,
        })
    }

    /// Ends the enrolment: the vehicle does not connect any more. What runs goes on.
    ///
    /// # Errors
    ///
    /// A failure if it is not enrolled, or the file cannot be removed.
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

    fn has_ended(&self) {
        if self.lock().state == LinkState::Connected {
            self.set_state(LinkState::Connecting, None, None);
        }
    }

    /// Sets the number of records that were not sent. It lacks the `unreadable` streams, which come
    /// with the causes: the reason names them while the vehicle is connected.
    fn set_unsent<'s>(
        &self,
        unsent: u64,
        mut unreadable: impl Iterator<Item = (&'s String, &'s String)>,
    ) {
        let reason = unreadable.next().map(|(name, cause)| {
            let (name, others) = (excerpt(name), unreadable.count());
            let others = if others > 0 { format!(" (and {others} more)") } else { String::new() };
            let cause = visible(cause);
            format!("stream `{name}`{others} cannot be sent, and is not counted: {cause}")
        });
        let mut shared = self.lock();
        shared.unsent = unsent;
        if shared.state == LinkState::Connected {
            shared.reason = reason;
        }
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
