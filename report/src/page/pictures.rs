//! Collects the pictures of the page: camera pictures at triggers, else the thumbnails of clips.
//!
//! The paths come from untrusted files: only small JPEG files inside the result folder are read.

use std::io;
use std::path::{Component, Path, PathBuf};

use gleaner_base::PlainFile;
use gleaner_lambda::results::PICTURE_MAX;
use gleaner_lambda::signals::TriggerPicture;

use super::collect::{named, positions};
use super::html::jpeg_address;
use super::model::{PageClip, PagePicture, TriggerEvent};
use crate::format::{cut, seconds};

const ALL_BYTES: usize = 2 << 20;

const THUMBNAILS_MAX: usize = 200;

pub(super) struct Pictures<'a> {
    out: &'a Path,
    start_ns: i64,
    budget: usize,
    pub(super) shown: Vec<PagePicture>,
    /// Number of pictures beyond the bounds.
    pub(super) omitted: u64,
    /// The first error, and the number of pictures with errors.
    refused: Option<(String, u64)>,
}

impl<'a> Pictures<'a> {
    pub(super) fn new(out: &'a Path, start_ns: i64, shares: usize) -> Self {
        Self {
            out,
            start_ns,
            budget: ALL_BYTES / shares,
            shown: Vec::new(),
            omitted: 0,
            refused: None,
        }
    }

    /// Adds camera pictures to the triggers of their wakes.
    pub(super) fn at_triggers(
        &mut self,
        triggers: &mut [TriggerEvent],
        pictures: &[TriggerPicture],
    ) {
        let triggers_at = positions(triggers.iter().map(|trigger| trigger.at_ns));
        for picture in pictures {
            let age = seconds(picture.at_ns, picture.image_ns);
            let Some(number) =
                self.add(&picture.file, picture.at_ns, cut(&picture.topic, 120), Some(age))
            else {
                continue;
            };
            for trigger in triggers_at.get(&picture.at_ns).into_iter().flatten() {
                triggers[*trigger].pictures.push(number);
            }
        }
    }

    /// Adds thumbnails of clips to triggers without a picture.
    pub(super) fn of_clips(
        &mut self,
        triggers: &mut [TriggerEvent],
        clips: &[PageClip],
        thumbnails: &[Option<PathBuf>],
    ) {
        for (clip, thumbnail) in clips.iter().zip(thumbnails) {
            let Some(thumbnail) = thumbnail else { continue };
            let is_in = |trigger: &TriggerEvent| {
                trigger.at_ns >= clip.span_ns[0] && trigger.at_ns <= clip.span_ns[1]
            };
            let waiting =
                |trigger: &&mut TriggerEvent| is_in(trigger) && trigger.pictures.is_empty();
            let mut waiting = triggers.iter_mut().filter(waiting).peekable();
            let Some(first) = waiting.peek() else { continue };
            if self.shown.len() >= THUMBNAILS_MAX {
                self.omitted += 1;
                continue;
            }
            if let Some(number) = self.add(thumbnail, first.at_ns, clip.file.clone(), None) {
                waiting.for_each(|trigger| trigger.pictures.push(number));
            }
        }
    }

    fn add(&mut self, file: &Path, at_ns: i64, source: String, age: Option<f64>) -> Option<usize> {
        let jpeg = match read(self.out, file) {
            Ok(jpeg) => jpeg,
            Err(why) => {
                let first = format!("picture {}: {why}", named(file.display()));
                self.refused.get_or_insert((first, 0)).1 += 1;
                return None;
            }
        };
        if jpeg.len() > self.budget {
            self.budget = 0;
            self.omitted += 1;
            return None;
        }
        self.budget -= jpeg.len();
        self.shown.push(PagePicture {
            t: seconds(at_ns, self.start_ns),
            source,
            age,
            src: jpeg_address(&jpeg),
        });
        Some(self.shown.len() - 1)
    }

    pub(super) fn note(&self) -> Option<String> {
        let (first, count) = self.refused.as_ref()?;
        Some(match count {
            1 => format!("{first}; omitted"),
            count => format!("{first}; it and {} more are omitted", count - 1),
        })
    }
}

fn read(out: &Path, file: &Path) -> io::Result<Vec<u8>> {
    if !file.components().all(|part| matches!(part, Component::Normal(_))) {
        return Err(io::Error::other("it is outside of the result folder"));
    }
    let jpeg = PlainFile::inside(out, file, PICTURE_MAX)?.read_whole()?;
    if !jpeg.starts_with(&[0xff, 0xd8, 0xff]) {
        return Err(io::Error::other("it is not a JPEG file"));
    }
    Ok(jpeg)
}
