//! Pictures that go into the page: what a camera saw at triggers, else the thumbnails of clips.
//!
//! Where they lie is said by files that others may have written: nothing outside of the output is
//! read, and nothing but a small JPEG.

use std::io;
use std::path::{Component, Path, PathBuf};

use gleaner_base::PlainFile;
use gleaner_lambda::results::PICTURE_MAX;
use gleaner_lambda::signals::Picture;

use super::gather::{named, places};
use super::html::jpeg_address;
use super::model::{ClipShown, Mark, PictureShown};
use crate::words::{cut, seconds};

/// Most bytes of all pictures on a page.
const ALL_BYTES: usize = 2 << 20;

/// Most pictures of clips.
const THUMBNAILS_MAX: usize = 200;

/// Collects them.
pub(super) struct Pictures<'a> {
    out: &'a Path,
    start_ns: i64,
    room: usize,
    pub(super) shown: Vec<PictureShown>,
    /// For which the page has no room.
    pub(super) left_out: u64,
    /// Why one cannot be used, the first, and how many.
    refused: Option<(String, u64)>,
}

impl<'a> Pictures<'a> {
    pub(super) fn new(out: &'a Path, start_ns: i64, shares: usize) -> Self {
        Self {
            out,
            start_ns,
            room: ALL_BYTES / shares,
            shown: Vec::new(),
            left_out: 0,
            refused: None,
        }
    }

    /// What cameras saw, each joined to the triggers of its wake.
    pub(super) fn at_triggers(&mut self, marks: &mut [Mark], pictures: &[Picture]) {
        let marks_at = places(marks.iter().map(|mark| mark.at_ns));
        for picture in pictures {
            let age = seconds(picture.at_ns, picture.image_ns);
            let Some(number) =
                self.add(&picture.file, picture.at_ns, cut(&picture.topic, 120), Some(age))
            else {
                continue;
            };
            for mark in marks_at.get(&picture.at_ns).into_iter().flatten() {
                marks[*mark].pictures.push(number);
            }
        }
    }

    /// Thumbnails of clips, for triggers that have no picture yet.
    pub(super) fn of_clips(
        &mut self,
        marks: &mut [Mark],
        clips: &[ClipShown],
        thumbnails: &[Option<PathBuf>],
    ) {
        for (clip, thumbnail) in clips.iter().zip(thumbnails) {
            let Some(thumbnail) = thumbnail else { continue };
            let is_in =
                |mark: &Mark| mark.at_ns >= clip.span_ns[0] && mark.at_ns <= clip.span_ns[1];
            let waiting = |mark: &&mut Mark| is_in(mark) && mark.pictures.is_empty();
            let mut waiting = marks.iter_mut().filter(waiting).peekable();
            let Some(first) = waiting.peek() else { continue };
            if self.shown.len() >= THUMBNAILS_MAX {
                self.left_out += 1;
                continue;
            }
            if let Some(number) = self.add(thumbnail, first.at_ns, clip.file.clone(), None) {
                waiting.for_each(|mark| mark.pictures.push(number));
            }
        }
    }

    fn add(&mut self, file: &Path, at_ns: i64, of: String, age: Option<f64>) -> Option<usize> {
        let jpeg = match read(self.out, file) {
            Ok(jpeg) => jpeg,
            Err(why) => {
                let first = format!("picture {}: {why}", named(file.display()));
                self.refused.get_or_insert((first, 0)).1 += 1;
                return None;
            }
        };
        if jpeg.len() > self.room {
            self.room = 0;
            self.left_out += 1;
            return None;
        }
        self.room -= jpeg.len();
        self.shown.push(PictureShown {
            t: seconds(at_ns, self.start_ns),
            of,
            age,
            src: jpeg_address(&jpeg),
        });
        Some(self.shown.len() - 1)
    }

    /// What is said of those that cannot be used.
    pub(super) fn note(&self) -> Option<String> {
        let (first, count) = self.refused.as_ref()?;
        Some(match count {
            1 => format!("{first}; it is left out"),
            count => format!("{first}; it and {} more are left out", count - 1),
        })
    }
}

/// The JPEG `file` of `out`.
fn read(out: &Path, file: &Path) -> io::Result<Vec<u8>> {
    // By its name, and by where links lead.
    if !file.components().all(|part| matches!(part, Component::Normal(_))) {
        return Err(io::Error::other("it is outside of the output"));
    }
    let jpeg = PlainFile::inside(out, file, PICTURE_MAX)?.read_whole()?;
    if !jpeg.starts_with(&[0xff, 0xd8, 0xff]) {
        return Err(io::Error::other("it is no JPEG"));
    }
    Ok(jpeg)
}
