//! The open clip files: messages, thumbnails, journals. All slow work of a clip is here: writing to
//! the disk, and decoding images.

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

/// Maximum number of images that are tried until one can be decoded. Each costs some milliseconds.
const IMAGE_TRIES: u32 = 8;

/// The data that completes a clip.
pub(in crate::recorder) struct ClipCompletion {
    pub(in crate::recorder) clip: u64,
    /// The name and header of its file, if the file is not created yet: no message came.
    pub(in crate::recorder) begin: Option<(String, ClipHeader)>,
    pub(in crate::recorder) trailer: ClipTrailer,
    /// Topics that have a channel even if no message came.
    pub(in crate::recorder) topics: Vec<Arc<TopicSchema>>,
    /// For each lambda: its name, and the header and the part of its journal.
    pub(in crate::recorder) journals: Vec<(String, Arc<JournalHeader>, JournalPart)>,
}

/// Writes clips into a folder. Several may be open.
pub(in crate::recorder) struct ClipFiles {
    folder: RecordingFolder,
    open: Vec<OpenFile>,
}

/// An open clip, with the state of its thumbnail.
#[derive(Default)]
struct OpenFile {
    clip: u64,
    file: Option<UnfinishedClip>,
    /// The topic whose images are tried for the thumbnail, once it is set.
    images: Option<usize>,
    /// The thumbnail, once an image was decoded.
    jpeg: Option<Vec<u8>>,
    /// Number of images that were tried.
    tried: u32,
}

impl OpenFile {
    fn try_image(&mut self, schema: &TopicSchema, meta: &SampleMeta, cdr: &[u8]) {
        if self.jpeg.is_none() && self.tried < IMAGE_TRIES {
            self.tried += 1;
            self.jpeg = thumbnail(&schema.type_name, cdr, meta.endian);
        }
    }

    fn file(&mut self) -> &mut UnfinishedClip {
        self.file.as_mut().expect("`begin` is called before anything is written to a clip")
    }
}

impl ClipFiles {
    pub(super) fn new(folder: RecordingFolder) -> ClipFiles {
        ClipFiles { folder, open: Vec::new() }
    }

    /// Takes the unfinished clips of an earlier process, to complete them.
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

    /// Tries the further messages of this topic for the thumbnail.
    pub(super) fn images(&mut self, clip: u64, topic: usize) {
        self.open_file(clip).images = Some(topic);
    }

    /// Makes the thumbnail from this message, if there is none yet and the message can be decoded.
    pub(super) fn image(&mut self, clip: u64, schema: &TopicSchema, meta: &SampleMeta, cdr: &[u8]) {
        self.open_file(clip).try_image(schema, meta, cdr);
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        schema: &TopicSchema,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let open_file = self.open_file(clip);
        if open_file.images == Some(topic) {
            open_file.try_image(schema, meta, cdr);
        }
        open_file.file().message(schema, meta, cdr)
    }

    /// Drops the state of a clip. Its unfinished file, if any, stays for recovery.
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
        let index = self
            .open
            .iter()
            .position(|open_file| open_file.clip == clip)
            .expect("its file was created");
        let open_file = self.open.swap_remove(index);
        trailer.thumbnail = open_file.jpeg;
        open_file.file.expect("its file was created").finish(trailer)
    }

    /// Deletes old clips to make room for a finished one, if there is a limit. If one cannot be
    /// deleted, that is retried after the next finished clip. Returns the losses.
    pub(super) fn make_room(&mut self, clip: &Clip) -> Vec<Loss> {
        self.folder.make_room(clip)
    }
}
