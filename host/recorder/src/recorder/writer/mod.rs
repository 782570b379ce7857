//! Writes clips: inline, in a replay, or on a background thread, so that a live recorder does not
//! wait for a disk.
//!
//! A [`ClipDisk`] is the folder and what is queued for it. Each clip has a [`ClipWriter`] of its
//! own, which writes until it is finished. Both kinds use the same calls of `file` in the same
//! order, so the files are the same.

mod file;
mod journal_part;
mod thread;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_lambda::Clip;
use gleaner_messages::transport::SampleMeta;
use gleaner_protocol::link::Loss;

use crate::RecordError;
use crate::file::{ClipHeader, RecordingFolder, TopicSchema};
pub use file::ClipCompletion;
use file::ClipFile;
pub use journal_part::JournalPart;
use thread::{QueuedClip, WriterThread};

/// Most bytes queued for the disk, except for one message that exceeds it.
const IN_FLIGHT: usize = 16 << 20;

#[derive(Copy, Clone, Debug)]
pub struct ClipSample<'a> {
    pub topic: usize,
    pub schema: &'a Arc<TopicSchema>,
    pub meta: &'a SampleMeta,
    pub cdr: &'a [u8],
}

pub enum ClipOutcome {
    /// It is complete and listed; with the losses from making room for it.
    Finished(Box<Clip>, Vec<Loss>),
    /// It was left unfinished or unlisted by an earlier process; as above.
    Recovered(Box<Clip>, Vec<Loss>),
    /// It failed; its written data is recovered when the folder is opened again.
    Failed(RecordError),
}

pub enum ClipDisk {
    /// Each call returns when its work is done.
    Inline(Arc<Mutex<RecordingFolder>>),
    /// Each call queues the work.
    Background(WriterThread),
}

impl ClipDisk {
    pub fn inline(folder: RecordingFolder) -> ClipDisk {
        ClipDisk::Inline(Arc::new(Mutex::new(folder)))
    }

    pub fn background(folder: RecordingFolder) -> Result<ClipDisk, RecordError> {
        Ok(ClipDisk::Background(WriterThread::start(folder)?))
    }

    pub fn new_clip(&mut self) -> ClipWriter {
        match self {
            ClipDisk::Inline(folder) => {
                let (folder, file) = (Arc::clone(folder), ClipFile::default());
                ClipWriter::Inline(Box::new(InlineClip { folder, file }))
            }
            ClipDisk::Background(thread) => ClipWriter::Queued(thread.new_clip()),
        }
    }

    /// Returns whether the queue has room. A caller that adds more anyway exceeds the limit.
    pub fn has_room(&self) -> bool {
        self.in_flight() < IN_FLIGHT
    }

    /// Returns whether the thread has no work, so that writers may send the few messages that they
    /// have collected.
    pub fn is_waiting(&self) -> bool {
        matches!(self, ClipDisk::Background(thread) if thread.queued() == 0)
    }

    pub fn poll(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipDisk::Inline(_) => Ok(()),
            ClipDisk::Background(thread) => thread.poll(outcomes),
        }
    }

    /// As [`poll`](Self::poll), but waits until a job is done, if there is one.
    pub fn wait(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        match self {
            ClipDisk::Inline(_) => Ok(()),
            ClipDisk::Background(thread) => thread.wait(outcomes),
        }
    }

    /// Ends the recording: the recovery of an earlier process's clips gets some more seconds.
    pub fn end_recovery(&self) {
        if let ClipDisk::Background(thread) = self {
            thread.end_recovery();
        }
    }

    /// Returns whether no work is queued or in progress.
    pub fn is_idle(&self) -> bool {
        match self {
            ClipDisk::Inline(_) => true,
            ClipDisk::Background(thread) => thread.in_flight() == 0 && !thread.is_recovering(),
        }
    }

    /// Bytes that are collected or queued, and not yet written.
    pub fn in_flight(&self) -> usize {
        match self {
            ClipDisk::Inline(_) => 0,
            ClipDisk::Background(thread) => thread.in_flight(),
        }
    }
}

/// Writes one clip. A clip whose writer is dropped stays unfinished: its file, if any, is recovered
/// later.
pub enum ClipWriter {
    Inline(Box<InlineClip>),
    Queued(QueuedClip),
}

/// A clip that is written within each call.
pub struct InlineClip {
    folder: Arc<Mutex<RecordingFolder>>,
    file: ClipFile,
}

impl InlineClip {
    fn folder(folder: &Mutex<RecordingFolder>) -> MutexGuard<'_, RecordingFolder> {
        folder.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ClipWriter {
    /// Creates the file, before anything is written to it.
    pub fn begin(&mut self, name: String, header: ClipHeader) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(inline) => {
                inline.file.begin(&mut InlineClip::folder(&inline.folder), &name, &header)
            }
            ClipWriter::Queued(queued) => queued.begin(name, header),
        }
    }

    pub fn thumbnail_of(&mut self, topic: usize) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(inline) => {
                inline.file.thumbnail_of(topic);
                Ok(())
            }
            ClipWriter::Queued(queued) => queued.thumbnail_of(topic),
        }
    }

    pub fn thumbnail(&mut self, sample: ClipSample<'_>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(inline) => {
                inline.file.thumbnail(sample);
                Ok(())
            }
            ClipWriter::Queued(queued) => queued.thumbnail(sample),
        }
    }

    pub fn write(&mut self, sample: ClipSample<'_>) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(inline) => inline.file.write(sample),
            ClipWriter::Queued(queued) => queued.write(sample),
        }
    }

    pub fn flush(&mut self) -> Result<(), RecordError> {
        match self {
            ClipWriter::Inline(_) => Ok(()),
            ClipWriter::Queued(queued) => queued.flush(),
        }
    }

    /// Completes the clip; returns it if that is done already.
    pub fn finish(self, completion: ClipCompletion) -> Result<Option<Clip>, RecordError> {
        match self {
            ClipWriter::Inline(inline) => {
                let InlineClip { folder, file } = *inline;
                let clip = file.finish(completion)?;
                // If one cannot be deleted, that is retried after the next finished clip.
                InlineClip::folder(&folder).make_room(&clip);
                Ok(Some(clip))
            }
            ClipWriter::Queued(queued) => queued.finish(completion).map(|()| None),
        }
    }
}
