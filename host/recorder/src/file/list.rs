//! `clips.jsonl`: a line for each complete clip.

use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Component, Path, PathBuf};

use gleaner_base::safe_file;
use gleaner_lambda::Clip;
use serde::Deserialize;
use tracing::warn;

use super::clip_dir::{CLIP, CLIPS, JPG};
use super::durable;
use crate::error::RecordError;

/// Longer lines were not written by this program. Our lines have some KB; at most 13 MB: 1,024
/// topics, whose names and types of 256 KiB may be in it and in six texts of `incomplete`, six
/// bytes for each if they are control characters, and 100 moments of some 3 KB.
const LINE_MAX: u64 = 16 << 20;

pub(super) struct ClipList {
    path: PathBuf,
    folder: PathBuf,
}

/// The file names in a line; other fields are ignored.
#[derive(Deserialize)]
struct ListLine {
    file: PathBuf,
    thumbnail: Option<PathBuf>,
}

/// File names of a listed clip, in the folder of clips.
pub(super) struct ListedClip {
    pub(super) file: String,
    pub(super) thumbnail: Option<String>,
}

impl ClipList {
    /// Returns the list in `folder`, which may not exist yet.
    pub(super) fn of(folder: &Path) -> Self {
        Self { path: folder.join("clips.jsonl"), folder: folder.to_owned() }
    }

    /// Returns the listed clips. A last line that was torn when its writer died is truncated.
    pub(super) fn read(&self) -> Result<Vec<ListedClip>, RecordError> {
        let failed = |source| RecordError::List { path: self.path.clone(), source };
        let file = match safe_file::edit(&self.path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(failed(error)),
        };
        let (listed, whole, len) = read_lines(&file, |_| Ok(())).map_err(failed)?;
        if whole < len {
            warn!(
                path = %self.path.display(),
                bytes = len - whole,
                "removed an incomplete last line of clips.jsonl"
            );
            file.set_len(whole).and_then(|()| file.sync_all()).map_err(failed)?;
        }
        Ok(listed)
    }

    /// Adds a clip. After an error the list is as it was.
    pub(super) fn append(&self, clip: &Clip) -> Result<(), RecordError> {
        let failed = |source| RecordError::List { path: self.path.clone(), source };
        let is_new = !self.path.exists();
        let mut file = safe_file::append(&self.path).map_err(failed)?;
        let before = file.metadata().map_err(failed)?.len();
        durable::step("append", &self.path).map_err(failed)?;
        if let Err(error) = file.write_all(&line(clip)).and_then(|()| file.sync_all()) {
            // A torn line would corrupt the next one. If this fails as well, the next start
            // truncates it.
            let _ = file.set_len(before);
            return Err(failed(error));
        }
        if is_new { durable::sync_folder(&self.folder) } else { Ok(()) }
    }

    /// Replaces the list by these clips, after the lines of other programs.
    pub(super) fn replace(&self, clips: &[Clip]) -> Result<(), RecordError> {
        durable::write_with(
            &self.folder.join("clips.jsonl.part"),
            &self.path,
            &self.folder,
            |file| {
                let mut new = BufWriter::new(file);
                match safe_file::read(&self.path) {
                    Ok(old) => {
                        read_lines(&old, |foreign| new.write_all(foreign))?;
                    }
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                    Err(error) => return Err(error),
                }
                clips.iter().try_for_each(|clip| new.write_all(&line(clip)))?;
                new.flush()
            },
        )
    }
}

fn line(clip: &Clip) -> Vec<u8> {
    let mut line = serde_json::to_vec(clip).expect("a clip is plain data");
    line.push(b'\n');
    line
}

/// Returns the clips in `file`, its bytes in whole lines, and all its bytes. Lines of other
/// programs are passed to `foreign`, each in one piece or, if longer than any of our lines, in
/// several.
pub(super) fn read_lines(
    file: &File,
    mut foreign: impl FnMut(&[u8]) -> io::Result<()>,
) -> io::Result<(Vec<ListedClip>, u64, u64)> {
    let mut reader = BufReader::new(file);
    let mut listed = Vec::new();
    let (mut at, mut whole, mut malformed) = (0, 0, 0_u64);
    let (mut line, mut too_long) = (Vec::new(), false);
    loop {
        line.clear();
        let read = reader.by_ref().take(LINE_MAX).read_until(b'\n', &mut line)? as u64;
        if read == 0 {
            break;
        }
        at += read;
        if !line.ends_with(b"\n") {
            if read == LINE_MAX || too_long {
                foreign(&line)?;
            }
            too_long = true;
            continue;
        }
        whole = at;
        match serde_json::from_slice::<ListLine>(&line).ok().filter(|_| !too_long).and_then(names) {
            Some(names) => listed.push(names),
            None => {
                malformed += 1;
                foreign(&line)?;
            }
        }
        too_long = false;
    }
    if malformed > 0 {
        warn!(malformed, "kept lines of clips.jsonl that do not name a clip of this program");
    }
    Ok((listed, whole, at))
}

fn names(line: ListLine) -> Option<ListedClip> {
    let thumbnail = line.thumbnail.and_then(|path| plain_name(&path, JPG));
    Some(ListedClip { file: plain_name(&line.file, CLIP)?, thumbnail })
}

/// Returns the file name of `path` if it is `clips/NAME` with that suffix and nothing else: listed
/// files get deleted, so the list must not name others.
pub(super) fn plain_name(path: &Path, suffix: &str) -> Option<String> {
    let mut components = path.components();
    let (folder, name) = (components.next()?, components.next()?);
    let (Component::Normal(folder), Component::Normal(name), None) =
        (folder, name, components.next())
    else {
        return None;
    };
    let fits = |name: &&str| {
        name.ends_with(suffix)
            && name.len() > suffix.len()
            && name.len() <= 255
            && !name.contains('\0')
    };
    let name = name.to_str().filter(fits)?;
    (folder == CLIPS && path.to_str()? == format!("{CLIPS}/{name}")).then(|| name.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_names_in_the_folder_of_clips_are_accepted() {
        assert_eq!(plain_name(Path::new("clips/a.mcap"), CLIP).as_deref(), Some("a.mcap"));
        let hostile = [
            "a.mcap",
            "clips/a\0.mcap",
            &format!("clips/{}.mcap", "a".repeat(251)),
            "../x.mcap",
            "clips/../x.mcap",
            "/clips/a.mcap",
            "clips//a.mcap",
            "clips/b/a.mcap",
            "clips/./a.mcap",
            "./clips/a.mcap",
            "clips/a.mcap/",
            "clips/a.jpg",
            "clips/.mcap",
            "other/a.mcap",
            "clips/..",
            "",
        ];
        for path in hostile {
            assert_eq!(plain_name(Path::new(path), CLIP), None, "{path}");
        }
    }
}
