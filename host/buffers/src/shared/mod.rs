//! Samples in memory that one process writes and other processes read in place.
//!
//! A [`SharedWriter`] owns a region: a header, places that name the newest samples, and slots that
//! hold their bytes. A [`SharedReader`] in another process maps the same region read-only. A reader
//! protects what it reads by *hazards*: words on its own control page that name windows of
//! positions. The writer reads them before it takes a slot, and trusts nothing else of that page: a
//! reader that writes garbage there loses its own protection only, and can pin no more positions
//! than its limits ([`PinLimits`]), which the writer keeps to itself. So a writer with `depth +
//! quotas + 1` slots always finds a free one, never waits, and no reader can change what another
//! one sees.
//!
//! # Order of memory accesses
//!
//! `seq[place]` is position + 1 while the sample is shown, else 0; positions never repeat. W is the
//! writer's SeqCst fence in each [`SharedWriter::draft`]; R is the reader's, between storing a
//! hazard and checking it.
//!
//! 1. A reader loads `seq` (Acquire), reads slot, length and meta (relaxed), stores the hazard
//!    (Release), fences (R), and loads `seq` again. If it changed, the reader clears the hazard and
//!    gives up. When it is done with the sample, it clears the hazard (Release).
//! 2. When a position leaves, the writer stores `seq = 0`. The next draft fences (W). If it has no
//!    free slot, it reads each hazard once (Acquire), and frees slots that are neither shown nor
//!    held. It fills one of them, then writes the place, `seq` and `head` (Release).
//! 3. If W precedes R in the order of SeqCst fences, the reader's second load sees the 0 or a later
//!    value, and the reader gives up. Otherwise the writer's scan sees the hazard, and leaves the
//!    slot alone, or it sees a later value of that word.
//! 4. That later value was stored with Release after the reader's last access, so the scan's
//!    Acquire load orders these accesses before our writes to the slot.
//! 5. A place is not torn: a field of a later sample is written after W, which follows `seq = 0`,
//!    so a reader that saw such a field sees the 0 or a later value in its second load.
//! 6. Payload reads are plain. Only a reader that breaks these rules sees torn bytes.
//! 7. A slot that was freed stays free until it is filled again: 3 holds for every later hazard
//!    that names its old position, as that position is not shown any more.
//! 8. The writer never starves: it reads each word once per W, and counts at most the limit of that
//!    word. The limits of all words of all readers fit into the region. So do the spare slots: each
//!    look finds as many free ones, so its cost is shared by as many drafts.
//!
//! One window is held by one word, as positions leave in order: the check of its oldest position
//! holds all of it. The places have to be read before the fence, because they are written again
//! while the samples are still held.

mod control;
mod hold;
mod layout;
mod notifier;
mod reader;
mod ring;
mod writer;

pub use control::{ControlMemory, ControlPage, HAZARDS, PinLimits};
pub use hold::{HeldSample, HeldWindow};
pub use layout::{META_WORDS, ReadRegion, ReaderMemory, SharedLayout, WriterMemory, in_process};
pub use notifier::{Futex, Notifier};
pub use reader::{ReadError, SharedReader};
pub(crate) use ring::SharedRing;
pub use writer::{ReaderId, SharedDraft, SharedWriter, WriteError};

#[cfg(loom)]
pub mod fences {
    //! Lets a model show that it fails without one of the fences.
    use std::sync::atomic::{AtomicBool, Ordering};

    /// Set by the one model that leaves out the reader's fence.
    pub static NO_READER_FENCE: AtomicBool = AtomicBool::new(false);
    /// Set by the one model that leaves out the writer's fence.
    pub static NO_WRITER_FENCE: AtomicBool = AtomicBool::new(false);

    /// Set by the one model that leaves out the fences of the bell.
    pub static NO_BELL_FENCE: AtomicBool = AtomicBool::new(false);

    pub(super) fn on(without: &AtomicBool) -> bool {
        !without.load(Ordering::Relaxed)
    }
}

/// The fence R.
fn reader_fence() {
    #[cfg(loom)]
    if !fences::on(&fences::NO_READER_FENCE) {
        return;
    }
    crate::sync::fence(crate::sync::Ordering::SeqCst);
}

/// The fence W.
fn writer_fence() {
    #[cfg(loom)]
    if !fences::on(&fences::NO_WRITER_FENCE) {
        return;
    }
    crate::sync::fence(crate::sync::Ordering::SeqCst);
}

/// The fence between the two words of a bell, on both sides.
fn bell_fence() {
    #[cfg(loom)]
    if !fences::on(&fences::NO_BELL_FENCE) {
        return;
    }
    crate::sync::fence(crate::sync::Ordering::SeqCst);
}
