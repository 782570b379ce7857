//! What a recorder that died left behind becomes whole clips.
//!
//! Every step may be the last one of this process, too. So each leaves the folder in a state that
//! the next attempt reads as it was meant: the unfinished file goes last, and a clip that was saved
//! says from which file.

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
use super::unfinished::{CHUNK_SPAN_NS, Saved, UnfinishedClip};
use super::{ClipTrailer, durable};
use crate::error::RecordError;

/// What an earlier process left in a folder. It is found before this one writes there, and
/// completed one by one.
#[derive(Default)]
pub(crate) struct Recovery {
    dir: Option<Arc<ClipDir>>,
    left: VecDeque<(&'static str, String)>,
}

/// Is called again and again while something takes long. It may do other things meanwhile; an error
/// of it ends what takes long.
pub(super) type Pause<'a> = dyn FnMut() -> Result<(), RecordError> + 'a;

impl Recovery {
    /// What is left in the folder of `dir`.
    pub(super) fn of(dir: &Arc<ClipDir>) -> Result<Recovery, RecordError> {
        let mut left = VecDeque::new();
        for suffix in [AGAIN, PART, CLIP] {
            left.extend(files(dir.folder(), suffix)?.into_iter().map(|name| (suffix, name)));
        }
        Ok(Recovery { dir: Some(Arc::clone(dir)), left })
    }

    /// The next clip that came back, which is listed, or why one did not: that is left as it is,
    /// for a later process. `go_on` is asked again and again; once it says no, what is under way is
    /// left as well, and nothing more comes.
    pub(crate) fn next(
        &mut self,
        go_on: &mut dyn FnMut() -> bool,
    ) -> Option<Result<Clip, RecordError>> {
        let dir = self.dir.as_ref()?;
        while go_on() {
            let (suffix, name) = self.left.pop_front()?;
            let mut pause = || match go_on() {
                true => Ok(()),
                // Nobody is told of it.
                false => Err(RecordError::Read {
                    path: dir.path(&name, suffix),
                    source: io::ErrorKind::Interrupted.into(),
                }),
            };
            let came = match suffix {
                AGAIN => discard_copy(dir, &name).map(|()| None),
                PART => recover(dir, &name, &mut pause),
                _ if dir.is_taken(&format!("{name}{CLIP}")) => Ok(None),
                _ => list(dir, &name, &mut pause),
            };
            match came {
                Ok(None) => {}
                Ok(Some(clip)) => return Some(Ok(clip)),
                Err(error) => return go_on().then_some(Err(error)),
            }
        }
        None
    }
}

/// The files in `folder` that end so, without the ending, sorted. What has another name, or is no
/// file, is not ours.
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

/// Removes the copy that a recovery had begun; what it was copied from is still there.
fn discard_copy(dir: &ClipDir, name: &str) -> Result<(), RecordError> {
    let path = dir.path(name, AGAIN);
    match origin(&path).map_err(|source| RecordError::Read { path: path.clone(), source })? {
        Origin::Foreign => {
            warn!(path = %path.display(), "file is not of this program, left alone");
            Ok(())
        }
        Origin::Ours | Origin::Nothing => durable::remove(&path).map(drop),
    }
}

/// Makes a clip of the unfinished clip `name`, if there is anything in it, and lists it.
fn recover(dir: &Arc<ClipDir>, name: &str, pause: &mut Pause) -> Result<Option<Clip>, RecordError> {
    let part = dir.path(name, PART);
    let recovered = attempt(dir, name, &part, pause);
    recovered.map_err(|source| RecordError::Recover { path: part, source: Box::new(source) })
}

/// Lists the clip `name`, which has its name and no line, if it is one of ours and whole.
fn list(dir: &ClipDir, name: &str, pause: &mut Pause) -> Result<Option<Clip>, RecordError> {
    let path = dir.path(name, CLIP);
    match origin(&path) {
        Ok(Origin::Ours) => {}
        Ok(_) => return Ok(None),
        Err(error) => {
            warn!(path = %path.display(), %error, "cannot read a file, left alone");
            return Ok(None);
        }
    }
    match read::whole(&path, pause) {
        // A clip that somebody copied here, under a name of theirs, is theirs.
        Ok(Some(clip)) if !is_own_name(name, &clip) => Ok(None),
        Ok(Some(clip)) => {
            // Whoever gave it its name may have died, or its disk lost its power, before the name
            // was on the disk.
            durable::sync_file(&path)?;
            durable::sync_folder(dir.folder())?;
            add(dir, name, clip).map(Some)
        }
        Ok(None) => {
            warn!(path = %path.display(), "clip is damaged and not listed, left alone");
            Ok(None)
        }
        Err(error) => {
            warn!(path = %path.display(), error = &error as &dyn std::error::Error, "cannot read a clip, left alone");
            Ok(None)
        }
    }
}

/// Whether a clip that is called `name` was called so by its recorder, or by a recovery that found
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
            warn!(path = %part.display(), "file is not of this program, left alone");
            return Ok(None);
        }
        Origin::Nothing => return discard(dir, name).map(|()| None),
        Origin::Ours => {}
    }
    // What an earlier attempt wrote, and did not complete.
    durable::remove(&dir.path(name, AGAIN))?;
    if was_saved(dir, name, part)? {
        // It is listed, or will be, by its own name, which may not be on the disk yet.
        durable::sync_folder(dir.folder())?;
        durable::remove(&dir.path(name, JPG_PART))?;
        durable::remove(part)?;
        return Ok(None);
    }
    match read::whole(part, pause)? {
        // It died just before the rename.
        Some(clip) => adopt(dir, name, part, clip, pause).map(Some),
        None => save(dir, name, part, pause),
    }
}

/// Whether an earlier attempt got as far as a whole clip: one that says so, or a copy of the
/// unfinished file.
fn was_saved(dir: &ClipDir, name: &str, part: &Path) -> Result<bool, RecordError> {
    let from = format!("{name}{PART}");
    for path in names(name)
        .map(|name| dir.path(&name, CLIP))
        .take_while(|path| path.symlink_metadata().is_ok())
    {
        if !path.symlink_metadata().is_ok_and(|found| found.is_file()) {
            // Not ours. A pipe would be waited for.
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

/// Whether two files have the same content.
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

/// The name for the clip of the unfinished file `name`: its own, as it was free when the file was
/// begun, unless somebody has put another file there since. No clip that is begun meanwhile gets
/// it.
fn name_for(dir: &ClipDir, name: &str) -> String {
    let is_free =
        |name: &String| !dir.exists(name, CLIP) && !dir.is_taken(&format!("{name}{CLIP}"));
    let free = names(name).find(is_free).expect("numbers do not end before the files do");
    dir.take(&free);
    free
}

/// Makes a clip of an unfinished file that is whole.
///
/// Its recorder may have died because the file could not be synced. The system then believes that
/// its pages are on the disk, and to sync it again would prove nothing: only bytes that are written
/// anew are known to arrive.
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
        // On a full disk, its room is wanted.
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

/// Lists a whole clip whose line is that of its own record.
fn add(dir: &ClipDir, name: &str, mut clip: Clip) -> Result<Clip, RecordError> {
    let path = dir.path(name, CLIP);
    let metadata =
        fs::metadata(&path).map_err(|source| RecordError::Read { path: path.clone(), source })?;
    clip.file = format!("{CLIPS}/{name}{CLIP}").into();
    clip.thumbnail = dir.exists(name, JPG).then(|| format!("{CLIPS}/{name}{JPG}").into());
    clip.bytes = metadata.len();
    // It is a result of the process that died, and not of the one that finds it.
    let note = "the recorder died before it listed this clip; nothing of it is lost".to_owned();
    clip.recovered.get_or_insert(Recovered { lost_bytes: 0, note });
    dir.add(name, &clip)?;
    info!(path = %path.display(), "clip was whole but not listed, now it is");
    Ok(clip)
}

/// Removes an unfinished clip without a message. Nothing that was acknowledged is lost by that.
fn discard(dir: &ClipDir, name: &str) -> Result<(), RecordError> {
    durable::remove(&dir.path(name, JPG_PART))?;
    if !dir.exists(name, CLIP) {
        durable::remove(&dir.path(name, JPG))?;
    }
    let part = dir.path(name, PART);
    let bytes = fs::metadata(&part).map_or(0, |metadata| metadata.len());
    warn!(path = %part.display(), bytes, "unfinished clip has no message, removed");
    durable::remove(&part).map(drop)
}

/// Copies the messages of `part` into a clip of their own.
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
    // A copy that did not come to its end; on a full disk, its room is wanted.
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
    warn!(path = %part.display(), messages = clip.messages(), lost_bytes, "unfinished clip of a dead recorder saved");
    let saved = Saved { recovered: Recovered { lost_bytes, note }, from: format!("{name}{PART}") };
    clip.close(suffix, &free, Some(saved)).map(Some)
}

/// Returns what happened and what is missing, for a person.
fn note(end: Option<&EarlyEnd>, kept_ns: i64, has_thumbnail: bool) -> String {
    let kept = kept_ns.max(0) as f64 / 1e9;
    let most = CHUNK_SPAN_NS / 1_000_000_000;
    let also = if has_thumbnail { "so is the journal" } else { "so are journal and thumbnail" };
    match end.map(|end| &end.why) {
        None | Some(Damage::Truncated(_) | Damage::NoFooter) => format!(
            "the recorder died; messages after {kept:.3} s of the window are lost, at most {most} s of them unless the \
             power failed; {also}"
        ),
        Some(why) => format!(
            "the recorder died and its file is damaged ({why}); messages after {kept:.3} s of the window are lost; {also}"
        ),
    }
}
