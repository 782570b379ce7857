//! The page through which `gleaner-shim` sees, without a message, what its runtime does and since
//! when.
//!
//! The shim makes it, and hands it on as a file that the runtime inherits; its number stands in
//! [`PULSE_ENV`]. The runtime says by when it will be back, before it enters code that is not ours.
//! A runtime without a shim has a page that nobody reads.
#![allow(unsafe_code)]

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use gleaner_protocol::{Doing, Killed, Why};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::time::{ClockId, clock_gettime};

use crate::handed_on::{hand_on, inherited};
use crate::own;

/// The environment variable with the number of the page's file.
pub const PULSE_ENV: &str = "GLEANER_PULSE";

/// What the page holds. Times are ns of CLOCK_MONOTONIC.
#[repr(C)]
struct Page {
    /// Since when the runtime does what it does.
    since_ns: AtomicU64,
    /// How long that may take; 0 if it may take as long as it likes. Written last.
    allowed_ns: AtomicU64,
    at_ns: AtomicI64,
    doing: AtomicU32,
    /// Not 0 once our part of the runtime was refused memory.
    full: AtomicU32,
    /// The lambda's share of the process, in bytes: memory before it was entered, without that of
    /// our own code.
    base: AtomicU64,
    /// Memory that it may take beyond that; 0 if it is counted elsewhere. Written after `base`.
    most: AtomicU64,
    /// Memory of our own code.
    own: AtomicU64,
    /// Pages of results that the shim did not write. Written by the shim alone.
    unwritten: AtomicU64,
}

/// What a lambda has of the memory of its process.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Share {
    /// Memory of the process before the lambda was entered, without that of our own code, in bytes.
    pub base: u64,
    /// Memory that the lambda may take.
    pub most: u64,
}

impl Share {
    /// What of the memory `held` of the process is the lambda's, where our code has `own`.
    pub fn used(self, held: u64, own: u64) -> u64 {
        held.saturating_sub(own).saturating_sub(self.base)
    }

    /// Whether `used` is more than the lambda may have. Not all in the process can be told apart:
    /// stacks of our threads, what C libraries of ours take, pages that are kept for the next small
    /// object, and the kernel's own rounding.
    pub fn is_exceeded_by(self, used: u64) -> bool {
        const TOLERANCE: u64 = 16 << 20;
        used > self.most.saturating_add(TOLERANCE)
    }
}

/// A view of the page. Clones see the same one.
#[derive(Clone)]
pub struct Pulse(Arc<Mapped>);

struct Mapped {
    page: NonNull<Page>,
}

// SAFETY: all fields of the page are atomics, so any thread may use them at any time; the mapping
// lives as long as this does.
unsafe impl Send for Mapped {}
// SAFETY: as above.
unsafe impl Sync for Mapped {}

/// The page of this process, for whoever finds that there is no memory left, and so can ask for
/// nothing.
static OURS: OnceLock<Pulse> = OnceLock::new();

/// How long it may take from the end of one call into a lambda until there is a word again: writing
/// results to a disk that stands still for a while, or reading on in a drive.
const BETWEEN: Duration = Duration::from_secs(300);

/// For the runtime: what was begun goes on until this is dropped.
#[must_use]
pub struct Busy<'a> {
    pulse: &'a Pulse,
}

impl Pulse {
    /// A new page, and the file to hand on. The file is closed by `exec` unless [`Pulse::hand_on`]
    /// was called.
    ///
    /// # Errors
    ///
    /// Those of `memfd_create` and `mmap`.
    pub fn make() -> io::Result<(Self, OwnedFd)> {
        let file = File::from(memfd_create(
            "gleaner-pulse",
            MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING,
        )?);
        file.set_len(size_of::<Page>() as u64)?;
        // Else the other side could cut it, and our next look would be our end.
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        let pulse = Self::over(file.as_fd())?;
        Ok((pulse, file.into()))
    }

    /// Has `file` survive `exec`; gives the value for [`PULSE_ENV`].
    ///
    /// # Errors
    ///
    /// Those of `fcntl`.
    pub fn hand_on(file: &OwnedFd) -> io::Result<String> {
        hand_on(file)
    }

    /// The page of this process's shim, or one that nobody reads.
    ///
    /// # Errors
    ///
    /// If the variable is set and names no such page, or there is no memory.
    pub fn inherited() -> io::Result<Self> {
        let Some(file) = inherited(PULSE_ENV)? else { return Ok(Self::make()?.0) };
        if rustix::fs::fstat(&file)?.st_size != size_of::<Page>() as i64 {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{PULSE_ENV} names no page"),
            ));
        }
        let pulse = Self::over(file.as_fd())?;
        Ok(OURS.get_or_init(|| pulse).clone())
    }

    /// Has the shim know that our part of this process was refused memory, should that be its end.
    /// Takes none.
    pub fn say_full() {
        if let Some(pulse) = OURS.get() {
            pulse.page().full.store(1, Ordering::Release);
        }
    }

    /// For the shim: whether the runtime was refused memory.
    pub fn was_full(&self) -> bool {
        self.page().full.load(Ordering::Acquire) != 0
    }

    /// Has the shim know the lambda's share of this process.
    pub fn set_share(&self, share: Share) {
        self.page().base.store(share.base, Ordering::Relaxed);
        self.page().most.store(share.most, Ordering::Release);
    }

    /// For the shim: the lambda's share, if it has one, and what of `held` it uses.
    pub fn share(&self, held: u64) -> Option<(Share, u64)> {
        let page = self.page();
        let most = page.most.load(Ordering::Acquire);
        let share = Share { base: page.base.load(Ordering::Relaxed), most };
        (most > 0).then(|| (share, share.used(held, page.own.load(Ordering::Relaxed))))
    }

    /// Has the shim know what our own code has taken. Takes none.
    pub(crate) fn tell_own() {
        if let Some(pulse) = OURS.get() {
            pulse.page().own.store(own::held(), Ordering::Relaxed);
        }
    }

    /// For the shim: so many pages of results were not written so far.
    pub fn set_unwritten(&self, pages: u64) {
        self.page().unwritten.store(pages, Ordering::Relaxed);
    }

    /// Pages of results that the shim did not write so far.
    pub fn unwritten(&self) -> u64 {
        self.page().unwritten.load(Ordering::Relaxed)
    }

    fn over(file: impl AsFd) -> io::Result<Self> {
        // SAFETY: a new mapping at an address that the kernel chooses overlaps nothing of ours.
        let page = unsafe {
            mmap(
                ptr::null_mut(),
                size_of::<Page>(),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED,
                file,
                0,
            )
        }?;
        let page = NonNull::new(page.cast()).ok_or_else(|| io::Error::other("mapped at 0"))?;
        Ok(Self(Arc::new(Mapped { page })))
    }

    fn page(&self) -> &Page {
        // SAFETY: the mapping is page-aligned, at least as large as a `Page`, lives as long as
        // `self.0`, and any bytes are valid values of its atomics. The file is sealed, so nobody
        // can cut it under us.
        unsafe { self.0.page.as_ref() }
    }

    /// From now on this process is busy with `doing`, and should be back within `allowed`. `at_ns`
    /// is the time of the wake.
    pub fn busy(&self, doing: Doing, allowed: Duration, at_ns: i64) -> Busy<'_> {
        // What was refused before was no end.
        self.page().full.store(0, Ordering::Release);
        self.set(doing, allowed, at_ns);
        Busy { pulse: self }
    }

    /// This process is alive, and will say so again within `allowed`.
    pub fn alive(&self, allowed: Duration) {
        self.set(Doing::Rounds, allowed, 0);
    }

    fn set(&self, doing: Doing, allowed: Duration, at_ns: i64) {
        let page = self.page();
        page.own.store(own::held(), Ordering::Relaxed);
        // Whoever reads meanwhile must not take the old allowance with the new time, or the other
        // way round.
        page.allowed_ns.store(0, Ordering::Release);
        page.since_ns.store(now_ns(), Ordering::Release);
        page.doing.store(doing as u32, Ordering::Release);
        page.at_ns.store(at_ns, Ordering::Release);
        page.allowed_ns
            .store(u64::try_from(allowed.as_nanos()).unwrap_or(u64::MAX), Ordering::Release);
    }

    /// For the shim: what the runtime reported last that it does.
    pub fn doing(&self) -> Doing {
        Doing::from_number(self.page().doing.load(Ordering::Acquire))
    }

    /// For the shim: what the runtime was to be done with by now, or how long it is before there is
    /// reason to look again.
    pub fn overdue(&self) -> Result<Killed, Duration> {
        /// A call that begins just after a look is seen this much later, at the most.
        const LOOK: Duration = Duration::from_millis(100);
        let read = || {
            let page = self.page();
            let allowed_ns = page.allowed_ns.load(Ordering::Acquire);
            let since_ns = page.since_ns.load(Ordering::Acquire);
            let doing = Doing::from_number(page.doing.load(Ordering::Acquire));
            (allowed_ns, since_ns, doing, page.at_ns.load(Ordering::Acquire))
        };
        let seen = read();
        let (allowed_ns, since_ns, doing, at_ns) = seen;
        if allowed_ns == 0 || read() != seen {
            return Err(LOOK);
        }
        let ran_ns = now_ns().saturating_sub(since_ns);
        if ran_ns >= allowed_ns {
            return Ok(Killed { doing, ran_ns, allowed_ns, at_ns, why: Why::Late });
        }
        Err(Duration::from_nanos(allowed_ns - ran_ns).min(LOOK))
    }

    /// For the shim: what the runtime does, killed for `why`. A runtime that writes meanwhile is
    /// seen in one of both states.
    pub fn killed(&self, why: Why) -> Killed {
        let page = self.page();
        let since_ns = page.since_ns.load(Ordering::Acquire);
        Killed {
            doing: Doing::from_number(page.doing.load(Ordering::Acquire)),
            ran_ns: now_ns().saturating_sub(since_ns),
            allowed_ns: page.allowed_ns.load(Ordering::Acquire),
            at_ns: page.at_ns.load(Ordering::Acquire),
            why,
        }
    }
}

impl Drop for Busy<'_> {
    fn drop(&mut self) {
        self.pulse.alive(BETWEEN);
    }
}

impl Drop for Mapped {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this size, and nothing refers to it any more: `page`
        // lends it for less than our life.
        let _ = unsafe { munmap(self.page.as_ptr().cast(), size_of::<Page>()) };
    }
}

fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_who_does_not_come_back_is_overdue() {
        let (pulse, file) = Pulse::make().unwrap();
        let seen = Pulse::over(file.as_fd()).unwrap();
        assert!(seen.overdue().is_err(), "nothing has begun");
        let busy = pulse.busy(Doing::Wake, Duration::from_secs(3600), 7);
        assert!(seen.overdue().is_err(), "there is time left");
        drop(busy);
        let busy = pulse.busy(Doing::Init, Duration::from_nanos(1), 9);
        let killed = seen.overdue().unwrap();
        assert_eq!((killed.doing, killed.allowed_ns, killed.at_ns), (Doing::Init, 1, 9));
        assert!(killed.ran_ns >= 1);
        drop(busy);
        assert!(seen.overdue().is_err(), "it came back, and has some time again");
        pulse.alive(Duration::from_nanos(1));
        assert_eq!(seen.overdue().unwrap().doing, Doing::Rounds);
    }

    #[test]
    fn a_lambda_is_charged_for_what_neither_we_nor_its_start_have_taken() {
        let (pulse, file) = Pulse::make().unwrap();
        let seen = Pulse::over(file.as_fd()).unwrap();
        assert_eq!(seen.share(1 << 30), None, "it is counted elsewhere");
        pulse.set_share(Share { base: 40 << 20, most: 64 << 20 });
        pulse.page().own.store(10 << 20, Ordering::Relaxed);
        let (share, used) = seen.share(100 << 20).unwrap();
        assert_eq!(used, 50 << 20);
        assert!(!share.is_exceeded_by(used) && share.is_exceeded_by(81 << 20));
        assert_eq!(seen.share(20 << 20).unwrap().1, 0);
    }
}
