//! How clips are written: here and now, as a replay does, or by a thread of its own, so that nobody
//! who records waits for a disk.
//!
//! Both are the same [`Scribe`]. What is said to it is in one order, so that the files are the
//! same.

pub(super) mod part;
mod scribe;
mod thread;

use std::sync::Arc;

use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use gleaner_transport::SampleMeta;

use crate::RecordError;
use crate::file::{About, Folder, Topic};
pub(super) use scribe::Last;
use scribe::Scribe;
use thread::Thread;

/// Bytes on their way to the disk at most, but for one message that goes beyond.
const IN_FLIGHT: usize = 16 << 20;

/// Writes clips.
pub(super) enum Pen {
    /// Each call returns when its work is done.
    Here(Box<Scribe>),
    /// Each call hands the work over.
    There(Thread),
}

/// What became of a clip.
pub(super) enum Outcome {
    /// It is whole, and listed; others had to go for it, or could not.
    Finished(Box<Clip>, Vec<Loss>),
    /// It is of an earlier process that left it unfinished, or unlisted; as above.
    Recovered(Box<Clip>, Vec<Loss>),
    /// It is not; what was written is recovered when the folder is opened again.
    Failed(RecordError),
}

impl Pen {
    /// Writes within each call.
    pub(super) fn here(folder: Folder) -> Pen {
        Pen::Here(Box::new(Scribe::new(folder)))
    }

    /// Writes in a thread of its own.
    pub(super) fn there(folder: Folder) -> Result<Pen, RecordError> {
        Ok(Pen::There(Thread::start(Scribe::new(folder))?))
    }

    /// Makes the file of a clip.
    pub(super) fn begin(
        &mut self,
        clip: u64,
        stem: String,
        about: About,
    ) -> Result<(), RecordError> {
        match self {
            Pen::Here(scribe) => scribe.begin(clip, &stem, &about),
            Pen::There(thread) => thread.begin(clip, stem, about),
        }
    }

    /// The picture of a clip is made from the messages of this topic.
    pub(super) fn images(&mut self, clip: u64, topic: usize) -> Result<(), RecordError> {
        match self {
            Pen::Here(scribe) => {
                scribe.images(clip, topic);
                Ok(())
            }
            Pen::There(thread) => thread.images(clip, topic),
        }
    }

    /// And best from this one.
    pub(super) fn image(
        &mut self,
        clip: u64,
        of: &Arc<Topic>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        match self {
            Pen::Here(scribe) => {
                scribe.image(clip, of, meta, cdr);
                Ok(())
            }
            Pen::There(thread) => thread.image(clip, of, meta, cdr),
        }
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &Arc<Topic>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        match self {
            Pen::Here(scribe) => scribe.message(clip, topic, of, meta, cdr),
            Pen::There(thread) => thread.message(clip, topic, of, meta, cdr),
        }
    }

    /// Forgets a clip in which is nothing.
    pub(super) fn forget(&mut self, clip: u64) -> Result<(), RecordError> {
        match self {
            Pen::Here(scribe) => {
                scribe.forget(clip);
                Ok(())
            }
            Pen::There(thread) => thread.forget(clip),
        }
    }

    /// Completes a clip, which is returned if that is done already.
    pub(super) fn finish(&mut self, last: Last) -> Result<Option<Clip>, RecordError> {
        match self {
            Pen::Here(scribe) => {
                let clip = scribe.finish(last)?;
                scribe.make_room(&clip);
                Ok(Some(clip))
            }
            Pen::There(thread) => thread.finish(last).map(|()| None),
        }
    }

    /// Whether more may be handed over. Whoever does it all the same makes the queue longer than it
    /// may be.
    pub(super) fn has_room(&self) -> bool {
        self.in_flight() < IN_FLIGHT
    }

    /// Hands over what was collected, if the thread has nothing else to do; and tells what became
    /// of clips.
    pub(super) fn poll(&mut self, outcomes: &mut Vec<Outcome>) -> Result<(), RecordError> {
        match self {
            Pen::Here(_) => Ok(()),
            Pen::There(thread) => thread.poll(outcomes),
        }
    }

    /// As [`poll`](Self::poll), and waits until something was done.
    pub(super) fn wait(&mut self, outcomes: &mut Vec<Outcome>) -> Result<(), RecordError> {
        match self {
            Pen::Here(_) => Ok(()),
            Pen::There(thread) => thread.wait(outcomes),
        }
    }

    /// The recording ends: what an earlier process left has some seconds to be recovered.
    pub(super) fn end_recovery(&self) {
        if let Pen::There(thread) = self {
            thread.end_recovery();
        }
    }

    /// Whether nothing is under way.
    pub(super) fn is_idle(&self) -> bool {
        match self {
            Pen::Here(_) => true,
            Pen::There(thread) => thread.in_flight() == 0 && !thread.is_recovering(),
        }
    }

    /// Bytes that were handed over and are not yet written.
    pub(super) fn in_flight(&self) -> usize {
        match self {
            Pen::Here(_) => 0,
            Pen::There(thread) => thread.in_flight(),
        }
    }
}
