//! A thread for what may wait for a disk: the search for definitions, and the checks of each
//! second.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_messages::Sources;
use gleaner_protocol::process_stats::usage;
use gleaner_samples::Waker;
use tracing::warn;

use super::connections::LoopEvent;

const HEALTH_INTERVAL: Duration = Duration::from_secs(1);

/// A request to search the definitions of a topic on this machine.
pub struct DefinitionsRequest {
    pub id: u32,
    pub type_name: String,
}

#[derive(Default)]
pub struct SystemHealth {
    pub disk_free: Option<u64>,
    pub rss_bytes: u64,
    pub cpu_s: f64,
}

pub struct Background {
    pub sources: Sources,
    pub requests: Receiver<DefinitionsRequest>,
    pub events: SyncSender<LoopEvent>,
    pub bell: Waker,
    pub out: PathBuf,
}

impl Background {
    /// Starts the thread, which runs until the loop drops its ends of the channels.
    pub fn start(self) -> std::io::Result<JoinHandle<()>> {
        Builder::new().name("background".to_owned()).spawn(move || self.run())
    }

    fn run(self) {
        let mut check_at = Instant::now() + HEALTH_INTERVAL;
        loop {
            let wait = check_at.saturating_duration_since(Instant::now());
            match self.requests.recv_timeout(wait) {
                Ok(DefinitionsRequest { id, type_name }) => {
                    let text = self.search(&type_name);
                    if self.events.send(LoopEvent::Definitions { id, text }).is_err() {
                        return;
                    }
                }
                Err(RecvTimeoutError::Timeout) => {
                    check_at = Instant::now() + HEALTH_INTERVAL;
                    let health = SystemHealth {
                        disk_free: free(&self.out),
                        rss_bytes: usage::resident(),
                        cpu_s: usage::cpu_seconds(),
                    };
                    match self.events.try_send(LoopEvent::Health(health)) {
                        // The next one comes soon.
                        Ok(()) | Err(TrySendError::Full(_)) => {}
                        Err(TrySendError::Disconnected(_)) => return,
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
            self.bell.ring();
        }
    }

    fn search(&self, type_name: &str) -> Option<Arc<str>> {
        self.sources.find(type_name).unwrap_or_else(|error| {
            let error = &error as &dyn std::error::Error;
            warn!(type_name = %visible(type_name), error, "cannot use the definitions of a type");
            None
        })
    }
}

/// Returns the free bytes on the disk of `folder`.
fn free(folder: &Path) -> Option<u64> {
    rustix::fs::statvfs(folder).ok().map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize))
}
