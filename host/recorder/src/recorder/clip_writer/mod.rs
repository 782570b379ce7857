//! Writes clips: inline, in a replay, or on a background thread, so that a live recorder does not
//! wait for a disk.
//!
//! Both use [`ClipFiles`], with the same calls in the same order, so the files are the same.

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

/// Most bytes queued for the disk, except for one message that exceeds it.
const IN_FLIGHT: usize = 16 << 20;

/// Writes clips.
pub(super) enum ClipWriter {
    /// Each call returns when its work is done.
    Inline(Box<ClipFiles>),
    /// Each call queues the work.
    Background(WriterThread),
}

/// The outcome of a clip.
pub(super) enum ClipOutcome {
    /// It is complete and listed; with the losses from making room for it.
    Finished(Box<Clip>, Vec<Loss>),
    /// It was left unfinished or unlisted by an earlier process; as above.
    Recovered(Box<Clip>, Vec<Loss>),
    /// It failed; its written data is recovered when the folder is opened again.
    Failed(RecordError),
}

impl ClipWriter {
    /// Writes within each call.
    pub(super) fn inline(folder: RecordingFolder) -> ClipWriter {
        ClipWriter::Inline(Box::new(ClipFiles::new(folder)))
    }

    /// Writes on a background thread.
    pub(super) fn background(folder: RecordingFolder) -> Result<ClipWriter, RecordError> {
        Ok(ClipWriter::Background(WriterThread::start(ClipFiles::new(folder))?))
    }

    /// Creates the file of a clip.
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

    /// Makes the thumbnail of a clip from the messages of this topic.
    pub(super) fn images(&mut self, clip: u64, topic: usize) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                files.images(clip, topic);
                Ok(())
            }
            ClipWriter::Background(thread) => thread.images(clip, topic),
        }
    }

    /// Makes the thumbnail preferably from this message.
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

    /// Drops an empty clip.
    pub(super) fn forget(&mut self, clip: u64) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(files) => {
                files.forget(clip);
                Ok(())
            }
            ClipWriter::Background(thread) => thread.forget(clip),
        }
    }

    /// Completes a clip; returns it if that is done already.
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

    /// Returns whether the queue has room. A caller that adds more anyway exceeds the limit.
    pub(super) fn has_room(&self) -> bool {
        self.in_flight() < IN_FLIGHT
    }

    /// Sends collected messages, if the thread is idle; collects the outcomes of clips.
    pub(super) fn poll(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(_) => Ok(()),
            ClipWriter::Background(thread) => thread.poll(outcomes),
        }
    }

    /// As [`poll`](Self::poll), but waits until a job is done.
    pub(super) fn wait(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(_) => Ok(()),
            ClipWriter::Background(thread) => thread.wait(outcomes),
        }
    }

    /// Ends the recording: the recovery of an earlier process's clips gets some more seconds.
    pub(super) fn end_recovery(&self) {
        if let ClipWriter::Background(thread) = self {
            thread.end_recovery();
        }
    }

    /// Returns whether no work is queued or in progress.
    pub(super) fn is_idle(&self) -> bool {
        match self {
            ClipWriter::Inline(_) => true,
            ClipWriter::Background(thread) => thread.in_flight() == 0 && !thread.is_recovering(),
        }
    }

    /// Bytes that are queued and not yet written.
    pub(super) fn in_flight(&self) -> usize {
        match self {
            ClipWriter::Inline(_) => 0,
            ClipWriter::Background(thread) => thread.in_flight(),
        }
    }
}
