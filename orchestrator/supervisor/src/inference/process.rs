//! The process. It sends a report when it starts, another one when its libraries are open, and then
//! one every 5 s at least.

use std::os::unix::net::UnixStream;
use std::process::Child;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::thread::JoinHandle;
use std::time::Duration;

/// Longest time between its first two reports: libraries may be read from a slow disk.
pub(super) const START: Duration = Duration::from_secs(60);

/// Longest time between two looks at the reports: this program may have stood still itself.
pub(super) const STEP: Duration = Duration::from_secs(1);

pub(super) struct Process {
    pub(super) child: Child,
    /// Open, as its end would mean that this program has ended.
    #[expect(dead_code, reason = "it is only kept open")]
    pub(super) handover: UnixStream,
    pub(super) readers: Vec<JoinHandle<()>>,
    pub(super) reports: Arc<AtomicU64>,
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Ok(None) = self.child.try_wait() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}
