//! Recovers the unfinished clips of a recorder that died.
//!
//! This process may die at any step, too. So each step leaves the folder in a state that the next
//! attempt reads correctly: the unfinished file is deleted last, and a recovered clip names the
//! file that it came from.

use std::collections::VecDeque;
use std::fs;
use std::io::{self, BufRead, BufReader};
use std::path::Path;
use std::sync::Arc;

use gleaner_base::safe_file;
use gleaner_drives::Damage;
use gleaner_lambda::{Clip, Recovered};
use tracing::{info, warn};

use super::clip_dir::{AGAIN, CLIP, CLIPS, ClipDir, JPG, JPG_PART, PART, names};
use super::origin::{Origin, origin};
use super::read::{self, EarlyEnd};
use super::unfinished::{CHUNK_SPAN_NS, RecoveredFrom, UnfinishedClip};
use super::{ClipTrailer, durable};
use crate::error::RecordError;

/// The unfinished clips of an earlier process in a folder. They are collected before this process
/// writes there, and completed one by one.
#[derive(Default)]
pub(crate) struct Recovery {
    dir: Option<Arc<ClipDir>>,
    unfinished: VecDeque<(&'static str, String)>,
}

/// Called repeatedly during a long operation. It may do other work meanwhile; its error aborts the
/// operation.
pub(super) type Pause<'a> = dyn FnMut() -> Result<(), RecordError> + 'a;

impl Recovery {
    /// Collects the unfinished clips in the folder of `dir`.
    pub(super) fn of(dir: &Arc<ClipDir>) -> Result<Recovery, RecordError> {
        let mut unfinished = VecDeque::new();
        for suffix in [AGAIN, PART, CLIP] {
            unfinished.extend(files(dir.folder(), suffix)?.into_iter().map(|name| (suffix, name)));
        }
        Ok(Recovery { dir: Some(Arc::clone(dir)), unfinished })
    }

    /// Returns the next recovered clip, which is listed, or the error of one that could not be
    /// recovered and is left unchanged for a later process. `go_on` is called repeatedly; once it
    /// returns false, the clip in progress is left as well, and no more are recovered.
    pub(crate) fn next(
        &mut self,
        go_on: &mut dyn FnMut() -> bool,
    ) -> Option<Result<Clip, RecordError>> {
        let dir = self.dir.as_ref()?;
        while go_on() {
            let (suffix, name) = self.unfinished.pop_front()?;
            let mut pause = || match go_on() {
                true => Ok(()),
                // This error is never reported.
                false => Err(RecordError::Read {
                    path: dir.path(&name, suffix),
                    source: io::ErrorKind::Interrupted.into(),
                }),
            };
            let result = match suffix {
                AGAIN => discard_copy(dir, &name).map(|()| None),
                PART => recover(dir, &name, &mut pause),
                _ if dir.is_taken(&format!("{name}{CLIP}")) => Ok(None),
                _ => list(dir, &name, &mut pause),
            };
            match result {
                Ok(None) => {}
                Ok(Some(clip)) => return Some(Ok(clip)),
                Err(error) => return go_on().then_some(Err(error)),
            }
        }
        None
    }
}

/// Returns the regular files in `folder` with this suffix, without the suffix, sorted.
fn files(folder: &Path, suffix: &str) -> Result<Vec<String>, RecordError> {
    let cannot_read = |source| RecordError::Read { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(cannot_read)? {
        let entry = entry.map_err(cannot_read)?;
        if !entry.file_type().is_ok_and(|kind| kind.is_file()) {
            continue;
        }
        if let Some(name) = entry.file_name().to_str().and_then(|name| name.strip_suffix(suffix)) {
            names.push(name.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Removes the copy that an earlier recovery began; its source still exists.
fn discard_copy(dir: &ClipDir, name: &str) -> Result<(), RecordError> {
    let path = dir.path(name, AGAIN);
    match origin(&path).map_err(|source| RecordError::Read { path: path.clone(), source })? {
        Origin::Foreign => {
            warn!(path = %path.display(), "file was not written by this program; left unchanged");
            Ok(())
        }
        Origin::Recorder | Origin::Nothing => durable::remove(&path).map(drop),
    }
}

/// Recovers the unfinished clip `name`, if it has any content, and lists it.
fn recover(dir: &Arc<ClipDir>, name: &str, pause: &mut Pause) -> Result<Option<Clip>, RecordError> {
    let part = dir.path(name, PART);
    let recovered = attempt(dir, name, &part, pause);
    recovered.map_err(|source| RecordError::Recover { path: part, source: Box::new(source) })
}

/// Lists the clip `name`, which has its final name but no line, if it is complete and written by a
/// recorder.
fn list(dir: &ClipDir, name: &str, pause: &mut Pause) -> Result<Option<Clip>, RecordError> {
    let path = dir.path(name, CLIP);
    match origin(&path) {
        Ok(Origin::Recorder) => {}
        Ok(_) => return Ok(None),
        Err(error) => {
            warn!(path = %path.display(), %error, "cannot read a file; left unchanged");
            return Ok(None);
        }
    }
    match read::complete_clip(&path, pause) {
        // A clip that was copied here under another name is not a result of this folder.
        Ok(Some(clip)) if !is_own_name(name, &clip) => Ok(None),
        Ok(Some(clip)) => {
            // The process that renamed it may have died, or the power failed, before the name was
            // on the disk.
            durable::sync_file(&path)?;
            durable::sync_folder(dir.folder())?;
            add(dir, name, clip).map(Some)
        }
        Ok(None) => {
            warn!(path = %path.display(), "clip is damaged and not listed; left unchanged");
            Ok(None)
        }
        Err(error) => {
            warn!(
                path = %path.display(),
                error = &error as &dyn std::error::Error,
                "cannot read a clip; left unchanged"
            );
            Ok(None)
        }
    }
}

/// Returns whether the clip `name` got that name from its recorder, or from a recovery that found
/// its name taken.
fn is_own_name(name: &str, clip: &Clip) -> bool {
    let own =
        clip.file.file_stem().map(|own| own.to_string_lossy().into_owned()).unwrap_or_default();
    let number = name.strip_prefix(&own).and_then(|rest| rest.strip_prefix('-'));
    name == own || number.is_some_and(|number| number.bytes().all(|digit| digit.is_ascii_digit()))
}

fn attempt(
    dir: &Arc<ClipDir>,
    name: &str,
    part: &Path,
    pause: &mut Pause,
) -> Result<Option<Clip>, RecordError> {
    match origin(part).map_err(|source| RecordError::Read { path: part.to_owned(), source })? {
        Origin::Foreign => {
            warn!(path = %part.display(), "file was not written by this program; left unchanged");
            return Ok(None);
        }
        Origin::Nothing => return discard(dir, name).map(|()| None),
        Origin::Recorder => {}
    }
    // The incomplete copy of an earlier attempt.
    durable::remove(&dir.path(name, AGAIN))?;
    if was_recovered(dir, name, part)? {
        // It is listed, or will be, under its own name, which may not be on the disk yet.
        durable::sync_folder(dir.folder())?;
        durable::remove(&dir.path(name, JPG_PART))?;
        durable::remove(part)?;
        return Ok(None);
    }
    match read::complete_clip(part, pause)? {
        // The recorder died just before the rename.
        Some(clip) => adopt(dir, name, part, clip, pause).map(Some),
        None => save(dir, name, part, pause),
    }
}

/// Returns whether an earlier attempt completed the clip: there is one that names this file as its
/// source, or a copy of the unfinished file.
fn was_recovered(dir: &ClipDir, name: &str, part: &Path) -> Result<bool, RecordError> {
    let from = format!("{name}{PART}");
    for path in names(name)
        .map(|name| dir.path(&name, CLIP))
        .take_while(|path| path.symlink_metadata().is_ok())
    {
        if !path.symlink_metadata().is_ok_and(|found| found.is_file()) {
            // Not a clip, and reading a pipe would block.
            continue;
        }
        let is_copy = || {
            is_same(&path, part).map_err(|source| RecordError::Read { path: path.clone(), source })
        };
        if read::recovered_from(&path).is_some_and(|named| named == from) || is_copy()? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Returns whether two files have the same content.
fn is_same(one: &Path, other: &Path) -> io::Result<bool> {
    let (one, other) = (safe_file::read(one)?, safe_file::read(other)?);
    if one.metadata()?.len() != other.metadata()?.len() {
        return Ok(false);
    }
    let (mut one, mut other) = (BufReader::new(one), BufReader::new(other));
    loop {
        let (left, right) = (one.fill_buf()?, other.fill_buf()?);
        let both = left.len().min(right.len());
        if left[..both] != right[..both] {
            return Ok(false);
        }
        if both == 0 {
            return Ok(left.len() == right.len());
        }
        one.consume(both);
        other.consume(both);
    }
}

/// Returns the name for the clip of the unfinished file `name`: its own, which was free when the
/// file was begun, unless another file has taken it since. The name is reserved.
fn name_for(dir: &ClipDir, name: &str) -> String {
    let is_free =
        |name: &String| !dir.exists(name, CLIP) && !dir.is_taken(&format!("{name}{CLIP}"));
    let free = names(name).find(is_free).expect("there are more numbers than files");
    dir.take(&free);
    free
}

/// Turns an unfinished file that is complete into a clip.
///
/// The recorder may have died because the file could not be synced. The system then treats the
/// pages of the file as written, and another sync would prove nothing: only bytes that are written
/// again are known to reach the disk.
fn adopt(
    dir: &ClipDir,
    name: &str,
    part: &Path,
    clip: Clip,
    pause: &mut Pause,
) -> Result<Clip, RecordError> {
    let free = name_for(dir, name);
    let again = dir.path(name, AGAIN);
    if let Err(error) = durable::copy(part, &again, pause) {
        // On a full disk, its room is needed.
        durable::remove(&again)?;
        return Err(error);
    }
    if free != name {
        // It belongs to no clip now.
        durable::remove(&dir.path(name, JPG))?;
    }
    durable::rename(&again, &dir.path(&free, CLIP), dir.folder())?;
    let clip = add(dir, &free, clip)?;
    durable::remove(&dir.path(name, JPG_PART))?;
    durable::remove(part)?;
    Ok(clip)
}

/// Lists a complete clip, by the line in its own record.
fn add(dir: &ClipDir, name: &str, mut clip: Clip) -> Result<Clip, RecordError> {
    let path = dir.path(name, CLIP);
    let metadata =
        fs::metadata(&path).map_err(|source| RecordError::Read { path: path.clone(), source })?;
    clip.file = format!("{CLIPS}/{name}{CLIP}").into();
    clip.thumbnail = dir.exists(name, JPG).then(|| format!("{CLIPS}/{name}{JPG}").into());
    clip.bytes = metadata.len();
    // It is a result of the process that died, not of this one.
    let note = "the recorder died before it listed this clip; nothing of it is lost".to_owned();
    clip.recovered.get_or_insert(Recovered { lost_bytes: 0, note });
    dir.add(name, &clip)?;
    info!(path = %path.display(), "listed a complete clip that was missing from the list");
    Ok(clip)
}

/// Removes an unfinished clip without a message. No acknowledged data is lost.
fn discard(dir: &ClipDir, name: &str) -> Result<(), RecordError> {
    durable::remove(&dir.path(name, JPG_PART))?;
    if !dir.exists(name, CLIP) {
        durable::remove(&dir.path(name, JPG))?;
    }
    let part = dir.path(name, PART);
    let bytes = fs::metadata(&part).map_or(0, |metadata| metadata.len());
    warn!(path = %part.display(), bytes, "removed an unfinished clip without messages");
    durable::remove(&part).map(drop)
}

/// Copies the messages of `part` into a new clip.
fn save(
    dir: &Arc<ClipDir>,
    name: &str,
    part: &Path,
    pause: &mut Pause,
) -> Result<Option<Clip>, RecordError> {
    let again = dir.path(name, AGAIN);
    let saved = copy(dir, name, part, pause);
    if saved.as_ref().is_ok_and(Option::is_some) {
        durable::remove(&dir.path(name, JPG_PART))?;
        durable::remove(part)?;
        return saved;
    }
    // An incomplete copy; on a full disk, its room is needed.
    durable::remove(&again)?;
    if saved.is_ok() {
        discard(dir, name)?;
    }
    saved
}

fn copy(
    dir: &Arc<ClipDir>,
    name: &str,
    part: &Path,
    pause: &mut Pause,
) -> Result<Option<Clip>, RecordError> {
    let len = fs::metadata(part)
        .map_err(|source| RecordError::Read { path: part.to_owned(), source })?
        .len();
    let clip_header = read::clip_header(part);
    let free = name_for(dir, name);
    let mut clip =
        UnfinishedClip::create(Arc::clone(dir), name.to_owned(), AGAIN, clip_header.as_ref())?;
    let end = read::each_message(part, |topic, meta, cdr| {
        pause()?;
        clip.message(topic, meta, cdr)
    })?;
    let Some((first_ns, last_ns)) = clip.span() else {
        return Ok(None);
    };
    let from_ns = clip_header.as_ref().map_or(first_ns, |clip_header| clip_header.from_ns);
    if free != name {
        // It belongs to no clip now.
        durable::remove(&dir.path(name, JPG))?;
    }
    let has_thumbnail = dir.exists(&free, JPG);
    let note = note(end.as_ref(), last_ns.saturating_sub(from_ns), has_thumbnail);
    let suffix = ClipTrailer {
        from_ns,
        to_ns: last_ns,
        triggers: u64::from(clip_header.is_some()),
        moments: clip_header.iter().map(|clip_header| clip_header.moment.clone()).collect(),
        lambdas: clip_header.map(|clip_header| clip_header.lambdas).unwrap_or_default(),
        incomplete: vec![note.clone()],
        ..ClipTrailer::default()
    };
    let lost_bytes = end.map_or(0, |end| len.saturating_sub(end.at));
    warn!(
        path = %part.display(),
        messages = clip.messages(),
        lost_bytes,
        "recovered an unfinished clip of a dead recorder"
    );
    let recovery =
        RecoveredFrom { recovered: Recovered { lost_bytes, note }, from: format!("{name}{PART}") };
    clip.close(suffix, &free, Some(recovery)).map(Some)
}

/// Describes for a user what happened and what is missing.
fn note(end: Option<&EarlyEnd>, kept_ns: i64, has_thumbnail: bool) -> String {
    let kept = kept_ns.max(0) as f64 / 1e9;
    let max_s = CHUNK_SPAN_NS / 1_000_000_000;
    let also = if has_thumbnail { "so is the journal" } else { "so are journal and thumbnail" };
    match end.map(|end| &end.why) {
        None | Some(Damage::Truncated(_) | Damage::NoFooter) => format!(
            "the recorder died; messages after {kept:.3} s of the window are lost, \
             at most {max_s} s of them unless the power failed; {also}"
        ),
        Some(why) => format!(
            "the recorder died and its file is damaged ({why}); messages after \
             {kept:.3} s of the window are lost; {also}"
        ),
    }
}
