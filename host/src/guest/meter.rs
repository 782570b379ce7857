//! Memory that a lambda takes of a process that it shares with our code.
//!
//! The kernel's own limit (RLIMIT_DATA) has room for our code, too, and does not count what was
//! filled and then made read-only. So the pages that the process really has are counted here after
//! its wakes, and by `gleaner-shim` ten times a second.

use std::io;
use std::time::{Duration, Instant};

use gleaner_lambda::{Fault, FaultKind};
use gleaner_vitals::usage::{PrivatePages, Process};
use gleaner_vitals::{Pulse, Share, own};

/// Time between two looks, at least. One takes about a microsecond, and a wake of a fast replay
/// seven.
const BETWEEN: Duration = Duration::from_millis(1);

/// Counts for one lambda.
pub(super) struct Meter {
    pages: PrivatePages,
    share: Share,
    looked: Option<Instant>,
}

impl Meter {
    /// Counts what the process takes from now on; `most` bytes of it are the lambda's. The shim
    /// counts, too.
    pub(super) fn start(most: u64, pulse: &Pulse) -> io::Result<Self> {
        let unreadable = || io::Error::other("/proc/self does not show the memory of this process");
        let pages = PrivatePages::open()?;
        let (private, held) = (pages.bytes(), Process::seen(None).map(|seen| seen.held));
        let own = own::held();
        let share = |taken: Option<u64>| {
            let base = taken.ok_or_else(unreadable)?.saturating_sub(own);
            Ok::<_, io::Error>(Share { base, most })
        };
        pulse.set_share(share(held)?);
        Ok(Self { pages, share: share(private)?, looked: None })
    }

    /// The fault of a lambda that has taken more than it may.
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
                "the lambda has {has:.1} MiB more than before its init; `memory` in [limits] allows {may:.1} MiB"
            );
            let (used, allowed) = (Some(used), Some(self.share.most));
            Fault { kind: FaultKind::Memory, message, used, allowed }
        })
    }
}
