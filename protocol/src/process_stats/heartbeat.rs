//! The shared page in which a runtime states its current activity, and the start of that activity,
//! for `gleaner-shim`.
//!
//! The shim creates it and passes it on as an inherited file; [`HEARTBEAT_ENV`] has its number.
//! Before the runtime enters foreign code, it writes the deadline of its return. A runtime without
//! a shim has a page without a reader.
#![allow(unsafe_code)]

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use crate::{KillReason, Killed, Phase};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::time::{ClockId, clock_gettime};

use crate::process_stats::inherited_file::{inherited, make_inheritable};
use crate::process_stats::own;

/// The environment variable with the file descriptor of the page.
pub const HEARTBEAT_ENV: &str = "GLEANER_PULSE";

/// Content of the page. Times are ns of CLOCK_MONOTONIC.
#[repr(C)]
struct PulsePage {
    /// Start of the current activity.
    since_ns: AtomicU64,
    /// Time allowed for it; 0 without a limit. Written last.
    allowed_ns: AtomicU64,
    at_ns: AtomicI64,
    phase: AtomicU32,
    /// Not 0 if Gleaner's code was refused memory since the runtime last began an activity.
    full: AtomicU32,
    /// The lambda's share of the process, in bytes: memory before it was entered, without that of
    /// Gleaner's code.
    base: AtomicU64,
    /// Memory that the lambda may take beyond that; 0 if it is counted elsewhere. Written after
    /// `base`.
    most: AtomicU64,
    /// Memory of Gleaner's code.
    own: AtomicU64,
    /// Number of result items that the shim did not write. Written by the shim alone.
    unwritten: AtomicU64,
}

/// The lambda's share of the memory of its process.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Share {
    /// Memory of the process before the lambda was entered, without that of Gleaner's code, in
    /// bytes.
    pub base: u64,
    /// Memory that the lambda may take, in bytes.
    pub most: u64,
}

impl Share {
    /// Returns the lambda's part of the memory `held` by the process, if Gleaner's code has `own`.
    pub fn used(self, held: u64, own: u64) -> u64 {
        held.saturating_sub(own).saturating_sub(self.base)
    }

    /// Returns whether `used` is more than the lambda may have. The tolerance covers memory that
    /// cannot be attributed: stacks of Gleaner's threads, its C libraries, pages kept for the next
    /// small object, and the kernel's rounding.
    pub fn is_exceeded_by(self, used: u64) -> bool {
        const TOLERANCE: u64 = 16 << 20;
        used > self.most.saturating_add(TOLERANCE)
    }
}

/// A view of the page. Clones share it.
#[derive(Clone)]
pub struct Heartbeat(Arc<MappedPage>);

struct MappedPage {
    page: NonNull<PulsePage>,
}

// SAFETY: all fields of the page are atomics, so any thread may use them at any time; the mapping
// lives as long as this value.
unsafe impl Send for MappedPage {}
// SAFETY: as above.
unsafe impl Sync for MappedPage {}

/// The page of this process, for code that has run out of memory and cannot allocate.
static PROCESS_PULSE: OnceLock<Heartbeat> = OnceLock::new();

/// Time allowed between the end of a call into a lambda and the next report, for example to
/// write results to a slow disk, or to read on in a drive.
const BETWEEN_CALLS: Duration = Duration::from_secs(300);

/// A guard for the runtime: the activity lasts until this is dropped.
#[must_use]
pub struct Busy<'a> {
    heartbeat: &'a Heartbeat,
}

impl Heartbeat {
    /// Creates a page, and the file to pass on. `exec` closes the file unless
    /// [`Heartbeat::make_inheritable`] was called.
    ///
    /// # Errors
    ///
    /// Errors of `memfd_create` and `mmap`.
    pub fn create() -> io::Result<(Self, OwnedFd)> {
        let file = File::from(memfd_create(
            "gleaner-heartbeat",
            MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING,
        )?);
        file.set_len(size_of::<PulsePage>() as u64)?;
        // Seal the size: a truncated memfd would kill the shim by SIGBUS.
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        let heartbeat = Self::map(file.as_fd())?;
        Ok((heartbeat, file.into()))
    }

    /// Makes `file` survive `exec`; returns the value for [`HEARTBEAT_ENV`].
    ///
    /// # Errors
    ///
    /// Errors of `fcntl`.
    pub fn make_inheritable(file: &OwnedFd) -> io::Result<String> {
        make_inheritable(file)
    }

    /// Returns the page of this process's shim, or one without a reader.
    ///
    /// # Errors
    ///
    /// If the variable is set and does not name such a page, or there is no memory.
    pub fn inherited() -> io::Result<Self> {
        let Some(file) = inherited(HEARTBEAT_ENV)? else { return Ok(Self::create()?.0) };
        if rustix::fs::fstat(&file)?.st_size != size_of::<PulsePage>() as i64 {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{HEARTBEAT_ENV} does not name a page"),
            ));
        }
        let heartbeat = Self::map(file.as_fd())?;
        Ok(PROCESS_PULSE.get_or_init(|| heartbeat).clone())
    }

    /// Reports to the shim that Gleaner's code in this process was refused memory, in case the
    /// process dies of it. Does not allocate.
    pub fn report_refused_memory() {
        if let Some(heartbeat) = PROCESS_PULSE.get() {
            heartbeat.page().full.store(1, Ordering::Release);
        }
    }

    /// For the shim: returns whether the runtime was refused memory.
    pub fn was_refused_memory(&self) -> bool {
        self.page().full.load(Ordering::Acquire) != 0
    }

    /// Reports the lambda's share of this process to the shim.
    pub fn set_share(&self, share: Share) {
        self.page().base.store(share.base, Ordering::Relaxed);
        self.page().most.store(share.most, Ordering::Release);
    }

    /// For the shim: returns the lambda's share, if it has one, and the part of `held` that it
    /// uses.
    pub fn share(&self, held: u64) -> Option<(Share, u64)> {
        let page = self.page();
        let most = page.most.load(Ordering::Acquire);
        let share = Share { base: page.base.load(Ordering::Relaxed), most };
        (most > 0).then(|| (share, share.used(held, page.own.load(Ordering::Relaxed))))
    }

    /// Reports the memory of Gleaner's code to the shim. Does not allocate.
    pub(crate) fn publish_own() {
        if let Some(heartbeat) = PROCESS_PULSE.get() {
            heartbeat.page().own.store(own::held(), Ordering::Relaxed);
        }
    }

    /// For the shim: sets the number of result items that were not written so far.
    pub fn set_unwritten(&self, items: u64) {
        self.page().unwritten.store(items, Ordering::Relaxed);
    }

    /// Returns the number of result items that the shim did not write so far.
    pub fn unwritten(&self) -> u64 {
        self.page().unwritten.load(Ordering::Relaxed)
    }

    fn map(file: impl AsFd) -> io::Result<Self> {
        // SAFETY: a new mapping at an address that the kernel chooses overlaps no other memory.
        let page = unsafe {
            mmap(
                ptr::null_mut(),
                size_of::<PulsePage>(),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED,
                file,
                0,
            )
        }?;
        let page = NonNull::new(page.cast()).ok_or_else(|| io::Error::other("mapped at 0"))?;
        Ok(Self(Arc::new(MappedPage { page })))
    }

    fn page(&self) -> &PulsePage {
        // SAFETY: the mapping is page-aligned, at least as large as a `PulsePage`, lives as long as
        // `self.0`, and any bytes are valid values of its atomics. The file is sealed, so no
        // process can truncate it.
        unsafe { self.0.page.as_ref() }
    }

    /// Begins the activity `phase`, which should end within `allowed`. `at_ns` is the time of the
    /// wake.
    pub fn busy(&self, phase: Phase, allowed: Duration, at_ns: i64) -> Busy<'_> {
        // An earlier refusal was not fatal.
        self.page().full.store(0, Ordering::Release);
        self.set(phase, allowed, at_ns);
        Busy { heartbeat: self }
    }

    /// Reports that this process is alive, and will report again within `allowed`.
    pub fn alive(&self, allowed: Duration) {
        self.set(Phase::Housekeeping, allowed, 0);
    }

    fn set(&self, phase: Phase, allowed: Duration, at_ns: i64) {
        let page = self.page();
        page.own.store(own::held(), Ordering::Relaxed);
        // A reader must not combine the old allowance with the new start, or the other way round.
        page.allowed_ns.store(0, Ordering::Release);
        page.since_ns.store(monotonic_ns(), Ordering::Release);
        page.phase.store(phase as u32, Ordering::Release);
        page.at_ns.store(at_ns, Ordering::Release);
        page.allowed_ns
            .store(u64::try_from(allowed.as_nanos()).unwrap_or(u64::MAX), Ordering::Release);
    }

    /// For the shim: returns the activity that the runtime reported last.
    pub fn phase(&self) -> Phase {
        Phase::from_number(self.page().phase.load(Ordering::Acquire))
    }

    /// For the shim: returns the overdue activity of the runtime, or the time until the next check.
    pub fn overdue(&self) -> Result<Killed, Duration> {
        /// Upper bound of the delay until a call that begins just after a check is seen.
        const CHECK_INTERVAL: Duration = Duration::from_millis(100);
        let read = || {
            let page = self.page();
            let allowed_ns = page.allowed_ns.load(Ordering::Acquire);
            let since_ns = page.since_ns.load(Ordering::Acquire);
            let phase = Phase::from_number(page.phase.load(Ordering::Acquire));
            (allowed_ns, since_ns, phase, page.at_ns.load(Ordering::Acquire))
        };
        let seen = read();
        let (allowed_ns, since_ns, phase, at_ns) = seen;
        if allowed_ns == 0 || read() != seen {
            return Err(CHECK_INTERVAL);
        }
        let ran_ns = monotonic_ns().saturating_sub(since_ns);
        if ran_ns >= allowed_ns {
            return Ok(Killed { phase, ran_ns, allowed_ns, at_ns, reason: KillReason::Overdue });
        }
        Err(Duration::from_nanos(allowed_ns - ran_ns).min(CHECK_INTERVAL))
    }

    /// For the shim: returns a record of the current activity, killed for `reason`. If the runtime
    /// begins another activity at the same time, the record may have values of both.
    pub fn killed(&self, reason: KillReason) -> Killed {
        let page = self.page();
        let since_ns = page.since_ns.load(Ordering::Acquire);
        Killed {
            phase: Phase::from_number(page.phase.load(Ordering::Acquire)),
            ran_ns: monotonic_ns().saturating_sub(since_ns),
            allowed_ns: page.allowed_ns.load(Ordering::Acquire),
            at_ns: page.at_ns.load(Ordering::Acquire),
            reason,
        }
    }
}

impl Drop for Busy<'_> {
    fn drop(&mut self) {
        self.heartbeat.alive(BETWEEN_CALLS);
    }
}

impl Drop for MappedPage {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this size, and no reference to it is left: `page` lends
        // it for less than the life of `self`.
        let _ = unsafe { munmap(self.page.as_ptr().cast(), size_of::<PulsePage>()) };
    }
}

/// Returns the time of CLOCK_MONOTONIC, in ns.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_runtime_that_does_not_return_is_overdue() {
        let (heartbeat, file) = Heartbeat::create().unwrap();
        let seen = Heartbeat::map(file.as_fd()).unwrap();
        assert!(seen.overdue().is_err(), "nothing has begun");
        let busy = heartbeat.busy(Phase::Wake, Duration::from_secs(3600), 7);
        assert!(seen.overdue().is_err(), "there is time left");
        drop(busy);
        let busy = heartbeat.busy(Phase::Init, Duration::from_nanos(1), 9);
        let killed = seen.overdue().unwrap();
        assert_eq!((killed.phase, killed.allowed_ns, killed.at_ns), (Phase::Init, 1, 9));
        assert!(killed.ran_ns >= 1);
        drop(busy);
        assert!(seen.overdue().is_err(), "it returned, and has some time again");
        heartbeat.alive(Duration::from_nanos(1));
        assert_eq!(seen.overdue().unwrap().phase, Phase::Housekeeping);
    }

    #[test]
    fn a_lambda_is_not_charged_for_the_start_and_for_our_own_memory() {
        let (heartbeat, file) = Heartbeat::create().unwrap();
        let seen = Heartbeat::map(file.as_fd()).unwrap();
        assert_eq!(seen.share(1 << 30), None, "it is counted elsewhere");
        heartbeat.set_share(Share { base: 40 << 20, most: 64 << 20 });
        heartbeat.page().own.store(10 << 20, Ordering::Relaxed);
        let (share, used) = seen.share(100 << 20).unwrap();
        assert_eq!(used, 50 << 20);
        assert!(!share.is_exceeded_by(used) && share.is_exceeded_by(81 << 20));
        assert_eq!(seen.share(20 << 20).unwrap().1, 0);
    }
}
