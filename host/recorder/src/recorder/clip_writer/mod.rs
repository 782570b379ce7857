//! How clips are written: here and now, as a replay does, or by a thread of its own, so that nobody
//! who records waits for a disk.
//!
//! Both are the same [`ClipFiles`]. What is said to it is in one order, so that the files are the
//! same.

mod clip_files;
pub(super) mod journal_part;
mod thread;

use std::sync::Arc;

use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use gleaner_transport::SampleMeta;

use crate::RecordError;
use crate::file::{ClipHeader, RecordingFolder, TopicSchema};
pub(super) use clip_files::ClipCompletion;
use clip_files::ClipFiles;
use thread::WriterThread;

/// Bytes on their way to the disk at most, but for one message that goes beyond.
const IN_FLIGHT: usize = 16 << 20;

/// Writes clips.
pub(super) enum ClipWriter {
    /// Each call returns when its work is done.
    Inline(Box<ClipFiles>),
    /// Each call hands the work over.
    Background(WriterThread),
}

/// What became of a clip.
pub(super) enum ClipOutcome {
    /// It is whole, and listed; others had to go for it, or could not.
    Finished(Box<Clip>, Vec<Loss>),
    /// It is of an earlier process that left it unfinished, or unlisted; as above.
    Recovered(Box<Clip>, Vec<Loss>),
    /// It is not; what was written is recovered when the folder is opened again.
    Failed(RecordError),
}

impl ClipWriter {
    /// Writes within each call.
    pub(super) fn inline(folder: RecordingFolder) -> ClipWriter {
        ClipWriter::Inline(Box::new(ClipFiles::new(folder)))
    }

    /// Writes in a thread of its own.
    pub(super) fn background(folder: RecordingFolder) -> Result<ClipWriter, RecordError> {
        Ok(ClipWriter::Background(WriterThread::start(ClipFiles::new(folder))?))
    }

    /// Makes the file of a clip.
    pub(super) fn begin(
        &mut self,
        clip: u64,
        clip_name: String,
        clip_header: ClipHeader,
    ) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => files.begin(clip, &clip_name, &clip_header),
            ClipWriter::Background(thread) => thread.begin(clip, clip_name, clip_header),
        }
    }

    /// The picture of a clip is made from the messages of this topic.
    pub(super) fn images(&mut self, clip: u64, topic: usize) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                files.images(clip, topic);
                Ok(())
            }
            ClipWriter::Background(thread) => thread.images(clip, topic),
        }
    }

    /// And best from this one.
    pub(super) fn image(
        &mut self,
        clip: u64,
        of: &Arc<TopicSchema>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                files.image(clip, of, meta, cdr);
                Ok(())
            }
            ClipWriter::Background(thread) => thread.image(clip, of, meta, cdr),
        }
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &Arc<TopicSchema>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => files.message(clip, topic, of, meta, cdr),
            ClipWriter::Background(thread) => thread.message(clip, topic, of, meta, cdr),
        }
    }

    /// Forgets a clip in which is nothing.
    pub(super) fn forget(&mut self, clip: u64) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                files.forget(clip);
                Ok(())
            }
            ClipWriter::Background(thread) => thread.forget(clip),
        }
    }

    /// Completes a clip, which is returned if that is done already.
    pub(super) fn finish(
        &mut self,
        completion: ClipCompletion,
    ) -> Result<Option<Clip>, RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                let clip = files.finish(completion)?;
                files.make_room(&clip);
                Ok(Some(clip))
            }
            ClipWriter::Background(thread) => thread.finish(completion).map(|()| None),
        }
    }

    /// Whether more may be handed over. Whoever does it all the same makes the queue longer than it
    /// may be.
    pub(super) fn has_room(&self) -> bool {
        self.in_flight() < IN_FLIGHT
    }

    /// Hands over what was collected, if the thread has nothing else to do; and tells what became
    /// of clips.
    pub(super) fn poll(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(_) => Ok(()),
            ClipWriter::Background(thread) => thread.poll(outcomes),
        }
    }

    /// As [`poll`](Self::poll), and waits until something was done.
    pub(super) fn wait(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(_) => Ok(()),
            ClipWriter::Background(thread) => thread.wait(outcomes),
        }
    }

    /// The recording ends: what an earlier process left has some seconds to be recovered.
    pub(super) fn end_recovery(&self) {
        if let ClipWriter::Background(thread) = self {
            thread.end_recovery();
        }
    }

    /// Whether nothing is under way.
    pub(super) fn is_idle(&self) -> bool {
        match self {
            ClipWriter::Inline(_) => true,
            ClipWriter::Background(thread) => thread.in_flight() == 0 && !thread.is_recovering(),
        }
    }

    /// Bytes that were handed over and are not yet written.
    pub(super) fn in_flight(&self) -> usize {
        match self {
            ClipWriter::Inline(_) => 0,
            ClipWriter::Background(thread) => thread.in_flight(),
        }
    }
}
