//! Measures the memory of a lambda in a process that it shares with Gleaner's own code.
//!
//! The kernel's own limit (RLIMIT_DATA) includes Gleaner's code, and does not count pages that were
//! filled and then made read-only. So the resident pages of the process are counted here after its
//! wakes, and by `gleaner-shim` ten times a second.

use std::io;
use std::time::{Duration, Instant};

use gleaner_lambda::{Fault, FaultKind};
use gleaner_protocol::process_stats::usage::{PrivatePages, ProcessUsage};
use gleaner_protocol::process_stats::{Heartbeat, Share, own};

/// Shortest time between two measurements. One takes about a microsecond, and a wake of a fast
/// replay seven.
const BETWEEN: Duration = Duration::from_millis(1);

pub(super) struct Meter {
    pages: PrivatePages,
    share: Share,
    looked: Option<Instant>,
}

impl Meter {
    /// Counts the memory that the process allocates from now on; `most` bytes of it are allowed to
    /// the lambda. The shim counts, too.
    pub(super) fn start(most: u64, heartbeat: &Heartbeat) -> io::Result<Self> {
        let unreadable = || io::Error::other("/proc/self does not show the memory of this process");
        let pages = PrivatePages::open()?;
        let (private, held) = (pages.bytes(), ProcessUsage::of(None).map(|seen| seen.held));
        let own = own::held();
        let share = |taken: Option<u64>| {
            let base = taken.ok_or_else(unreadable)?.saturating_sub(own);
            Ok::<_, io::Error>(Share { base, most })
        };
        heartbeat.set_share(share(held)?);
        Ok(Self { pages, share: share(private)?, looked: None })
    }

    /// The fault of a lambda that uses more memory than allowed.
    pub(super) fn fault(&mut self) -> Option<Fault> {
        if self.looked.is_some_and(|looked| looked.elapsed() < BETWEEN) {
            return None;
        }
        self.looked = Some(Instant::now());
        let used = self.share.used(self.pages.bytes()?, own::held());
        self.share.is_exceeded_by(used).then(|| {
            let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
            let (has, may) = (mib(used), mib(self.share.most));
            let message = format!(
                "the lambda has {has:.1} MiB more than before its init; `memory` in [limits] \
                 allows {may:.1} MiB"
            );
            let (used, allowed) = (Some(used), Some(self.share.most));
            Fault { kind: FaultKind::Memory, message, used, allowed }
        })
    }
}
