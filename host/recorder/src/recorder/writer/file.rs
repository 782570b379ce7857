//! The file of one clip: messages, thumbnail, journals. All slow work of a clip is here: writing to
//! the disk, and decoding images.

use std::sync::Arc;

use gleaner_journal::JournalHeader;
use gleaner_lambda::Clip;

use super::ClipSample;
use super::journal_part::JournalPart;
use crate::RecordError;
use crate::file::{ClipHeader, ClipTrailer, RecordingFolder, TopicSchema, UnfinishedClip};
use crate::thumbnail::thumbnail;

/// Maximum number of images that are tried until one can be decoded. Each costs some milliseconds.
const IMAGE_TRIES: u32 = 8;

pub struct ClipCompletion {
    pub trailer: ClipTrailer,
    /// Topics that have a channel even if no message came.
    pub topics: Vec<Arc<TopicSchema>>,
    /// For each lambda: its name, and the header and the part of its journal.
    pub journals: Vec<(String, Arc<JournalHeader>, JournalPart)>,
}

/// An open file, with the state of its thumbnail.
#[derive(Default)]
pub struct ClipFile {
    /// `None` until it is begun.
    file: Option<UnfinishedClip>,
    /// The topic whose images are tried for the thumbnail, once it is set.
    images: Option<usize>,
    /// The thumbnail, once an image was decoded.
    jpeg: Option<Vec<u8>>,
    tried: u32,
}

impl ClipFile {
    pub fn begin(
        &mut self,
        folder: &mut RecordingFolder,
        name: &str,
        header: &ClipHeader,
    ) -> Result<(), RecordError> {
        self.file = Some(folder.begin(name, header)?);
        Ok(())
    }

    /// Tries the further messages of this topic for the thumbnail.
    pub fn thumbnail_of(&mut self, topic: usize) {
        self.images = Some(topic);
    }

    /// Makes the thumbnail from this message, if there is none yet and the message can be decoded.
    pub fn thumbnail(&mut self, ClipSample { schema, meta, cdr, .. }: ClipSample<'_>) {
        if self.jpeg.is_none() && self.tried < IMAGE_TRIES {
            self.tried += 1;
            self.jpeg = thumbnail(&schema.type_name, cdr, meta.endian);
        }
    }

    pub fn write(&mut self, sample: ClipSample<'_>) -> Result<(), RecordError> {
        if self.images == Some(sample.topic) {
            self.thumbnail(sample);
        }
        self.file().message(sample.schema, sample.meta, sample.cdr)
    }

    /// Completes the clip. When this returns, all of it is on the disk.
    pub fn finish(mut self, completion: ClipCompletion) -> Result<Clip, RecordError> {
        let ClipCompletion { mut trailer, topics, journals } = completion;
        for topic in &topics {
            self.file().declare(topic)?;
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
        trailer.thumbnail = self.jpeg.take();
        self.file.expect("its file was created").finish(trailer)
    }

    fn file(&mut self) -> &mut UnfinishedClip {
        self.file.as_mut().expect("`begin` is called before anything is written to a clip")
    }
}
