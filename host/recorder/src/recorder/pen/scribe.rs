//! Who writes clips: their files, their pictures, their journals. All that takes long is here.

use std::sync::Arc;

use gleaner_journal::Header;
use gleaner_lambda::Clip;
use gleaner_protocol::link::Loss;
use gleaner_transport::SampleMeta;

use super::part::Part;
use crate::RecordError;
use crate::file::{About, Ending, Folder, Recovery, Topic, Unfinished};
use crate::thumbnail::thumbnail;

/// Images that are tried until one can be read. Each costs some milliseconds.
const TRIES: u32 = 8;

/// A clip that comes to its end.
pub(in crate::recorder) struct Last {
    pub(in crate::recorder) clip: u64,
    /// Where its file begins, if no message of it came.
    pub(in crate::recorder) begin: Option<(String, About)>,
    pub(in crate::recorder) ending: Ending,
    /// Topics that have a channel even if no message came.
    pub(in crate::recorder) topics: Vec<Arc<Topic>>,
    /// Of each lambda: the name of its journal, and what is in it.
    pub(in crate::recorder) journals: Vec<(String, Arc<Header>, Part)>,
}

/// Writes clips into a folder. Several may be open.
pub(in crate::recorder) struct Scribe {
    folder: Folder,
    sheets: Vec<Sheet>,
}

/// A clip that is open.
#[derive(Default)]
struct Sheet {
    clip: u64,
    file: Option<Unfinished>,
    /// The topic that its picture is made from, once it has one with images.
    images: Option<usize>,
    jpeg: Option<Vec<u8>>,
    tried: u32,
}

impl Sheet {
    fn try_image(&mut self, topic: &Topic, meta: &SampleMeta, cdr: &[u8]) {
        if self.jpeg.is_none() && self.tried < TRIES {
            self.tried += 1;
            self.jpeg = thumbnail(&topic.type_name, cdr, meta.endian);
        }
    }

    fn file(&mut self) -> &mut Unfinished {
        self.file.as_mut().expect("a clip is begun before anything is written to it")
    }
}

impl Scribe {
    pub(super) fn new(folder: Folder) -> Scribe {
        Scribe { folder, sheets: Vec::new() }
    }

    /// What an earlier process left in the folder.
    pub(super) fn take_left(&mut self) -> Recovery {
        self.folder.take_left()
    }

    fn sheet(&mut self, clip: u64) -> &mut Sheet {
        let index = self.sheets.iter().position(|sheet| sheet.clip == clip).unwrap_or_else(|| {
            self.sheets.push(Sheet { clip, ..Sheet::default() });
            self.sheets.len() - 1
        });
        &mut self.sheets[index]
    }

    /// Makes the file of a clip.
    pub(super) fn begin(
        &mut self,
        clip: u64,
        stem: &str,
        about: &About,
    ) -> Result<(), RecordError> {
        let file = self.folder.begin(stem, about)?;
        self.sheet(clip).file = Some(file);
        Ok(())
    }

    /// From now on the picture is made from the messages of this topic.
    pub(super) fn images(&mut self, clip: u64, topic: usize) {
        self.sheet(clip).images = Some(topic);
    }

    /// Makes the picture from this message, if it can be.
    pub(super) fn image(&mut self, clip: u64, of: &Topic, meta: &SampleMeta, cdr: &[u8]) {
        self.sheet(clip).try_image(of, meta, cdr);
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &Topic,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let sheet = self.sheet(clip);
        if sheet.images == Some(topic) {
            sheet.try_image(of, meta, cdr);
        }
        sheet.file().message(of, meta, cdr)
    }

    /// Forgets a clip. If it has a file, that stays for recovery.
    pub(super) fn forget(&mut self, clip: u64) {
        self.sheets.retain(|sheet| sheet.clip != clip);
    }

    /// Completes a clip. When this returns, all of it is on the disk.
    pub(super) fn finish(&mut self, last: Last) -> Result<Clip, RecordError> {
        let Last { clip, begin, mut ending, topics, journals } = last;
        if let Some((stem, about)) = begin {
            self.begin(clip, &stem, &about)?;
        }
        for topic in &topics {
            self.sheet(clip).file().declare(topic)?;
        }
        for (name, header, part) in journals {
            match part.write(&header) {
                None => {}
                Some(Ok(journal)) => ending.journals.push((name, journal)),
                Some(Err(error)) => {
                    tracing::error!(lambda = %name, %error, "the journal of a clip cannot be written");
                    ending
                        .short
                        .push(format!("the journal of {name} could not be written: {error}"));
                }
            }
        }
        let index = self.sheets.iter().position(|sheet| sheet.clip == clip).expect("it was begun");
        let sheet = self.sheets.swap_remove(index);
        ending.thumbnail = sheet.jpeg;
        sheet.file.expect("it was begun").finish(ending)
    }

    /// Makes room for a clip that was finished, if there is a bound. What cannot be deleted stays,
    /// and is tried again with the next.
    pub(super) fn make_room(&mut self, clip: &Clip) -> Vec<Loss> {
        self.folder.added(clip)
    }
}
