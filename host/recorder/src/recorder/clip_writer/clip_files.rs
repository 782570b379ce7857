//! The open clip files: messages, thumbnails, journals. All slow work is here.

use std::sync::Arc;

use gleaner_journal::JournalHeader;
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use gleaner_transport::SampleMeta;

use super::journal_part::JournalPart;
use crate::RecordError;
use crate::file::{
    ClipHeader, ClipTrailer, RecordingFolder, Recovery, TopicSchema, UnfinishedClip,
};
use crate::thumbnail::thumbnail;

/// Images that are tried until one can be decoded. Each costs some milliseconds.
const TRIES: u32 = 8;

/// The data that completes a clip.
pub(in crate::recorder) struct ClipCompletion {
    pub(in crate::recorder) clip: u64,
    /// The name and header of its file, if it has no message.
    pub(in crate::recorder) begin: Option<(String, ClipHeader)>,
    pub(in crate::recorder) trailer: ClipTrailer,
    /// Topics that have a channel even if no message came.
    pub(in crate::recorder) topics: Vec<Arc<TopicSchema>>,
    /// For each lambda: the name of its journal, and its part.
    pub(in crate::recorder) journals: Vec<(String, Arc<JournalHeader>, JournalPart)>,
}

/// Writes clips into a folder. Several may be open.
pub(in crate::recorder) struct ClipFiles {
    folder: RecordingFolder,
    open: Vec<OpenFile>,
}

/// An open clip.
#[derive(Default)]
struct OpenFile {
    clip: u64,
    file: Option<UnfinishedClip>,
    /// The topic of its thumbnail, once it has one with images.
    images: Option<usize>,
    jpeg: Option<Vec<u8>>,
    tried: u32,
}

impl OpenFile {
    fn try_image(&mut self, topic: &TopicSchema, meta: &SampleMeta, cdr: &[u8]) {
        if self.jpeg.is_none() && self.tried < TRIES {
            self.tried += 1;
            self.jpeg = thumbnail(&topic.type_name, cdr, meta.endian);
        }
    }

    fn file(&mut self) -> &mut UnfinishedClip {
        self.file.as_mut().expect("a clip is begun before anything is written to it")
    }
}

impl ClipFiles {
    pub(super) fn new(folder: RecordingFolder) -> ClipFiles {
        ClipFiles { folder, open: Vec::new() }
    }

    /// Takes the unfinished clips of an earlier process.
    pub(super) fn take_unfinished(&mut self) -> Recovery {
        self.folder.take_unfinished()
    }

    fn open_file(&mut self, clip: u64) -> &mut OpenFile {
        let index =
            self.open.iter().position(|open_file| open_file.clip == clip).unwrap_or_else(|| {
                self.open.push(OpenFile { clip, ..OpenFile::default() });
                self.open.len() - 1
            });
        &mut self.open[index]
    }

    /// Creates the file of a clip.
    pub(super) fn begin(
        &mut self,
        clip: u64,
        clip_name: &str,
        clip_header: &ClipHeader,
    ) -> Result<(), RecordError> {
        let file = self.folder.begin(clip_name, clip_header)?;
        self.open_file(clip).file = Some(file);
        Ok(())
    }

    /// Makes the thumbnail from the messages of this topic from now on.
    pub(super) fn images(&mut self, clip: u64, topic: usize) {
        self.open_file(clip).images = Some(topic);
    }

    /// Makes the thumbnail from this message, if possible.
    pub(super) fn image(&mut self, clip: u64, of: &TopicSchema, meta: &SampleMeta, cdr: &[u8]) {
        self.open_file(clip).try_image(of, meta, cdr);
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &TopicSchema,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let open_file = self.open_file(clip);
        if open_file.images == Some(topic) {
            open_file.try_image(of, meta, cdr);
        }
        open_file.file().message(of, meta, cdr)
    }

    /// Drops a clip. Its file, if any, stays for recovery.
    pub(super) fn forget(&mut self, clip: u64) {
        self.open.retain(|open_file| open_file.clip != clip);
    }

    /// Completes a clip. When this returns, all of it is on the disk.
    pub(super) fn finish(&mut self, completion: ClipCompletion) -> Result<Clip, RecordError> {
        let ClipCompletion { clip, begin, mut trailer, topics, journals } = completion;
        if let Some((clip_name, clip_header)) = begin {
            self.begin(clip, &clip_name, &clip_header)?;
        }
        for topic in &topics {
            self.open_file(clip).file().declare(topic)?;
        }
        for (name, header, part) in journals {
            match part.write(&header) {
                None => {}
                Some(Ok(journal)) => trailer.journals.push((name, journal)),
                Some(Err(error)) => {
                    tracing::error!(
                        lambda = %name,
                        %error,
                        "cannot write the journal of a clip"
                    );
                    trailer
                        .incomplete
                        .push(format!("the journal of {name} could not be written: {error}"));
                }
            }
        }
        let index =
            self.open.iter().position(|open_file| open_file.clip == clip).expect("it was begun");
        let open_file = self.open.swap_remove(index);
        trailer.thumbnail = open_file.jpeg;
        open_file.file.expect("it was begun").finish(trailer)
    }

    /// Makes room for a finished clip, if there is a limit. A clip that cannot be deleted stays,
    /// and is retried with the next one.
    pub(super) fn make_room(&mut self, clip: &Clip) -> Vec<Loss> {
        self.folder.added(clip)
    }
}
