//! `clips/.replaced`: the clips that a replay is about to delete, noted before the list loses them.
//! It is gone once they are.

use std::collections::HashSet;
use std::fs;
use std::io;
use std::path::Path;

use gleaner_base::safe_file;
use tracing::warn;

use super::clip_dir::CLIPS;
use super::durable;
use super::list::{ClipList, ListedClip, read_lines};
use crate::error::RecordError;

const NOTE: &str = ".replaced";
/// The note while it is written.
const NOTE_PART: &str = ".replaced.part";

/// Notes in the folder of clips that these go.
pub(super) fn note(folder: &Path, doomed: &[ListedClip]) -> Result<(), RecordError> {
    if doomed.is_empty() {
        return Ok(());
    }
    let lines: Vec<u8> = doomed.iter().flat_map(line).collect();
    durable::write(&folder.join(NOTE_PART), &folder.join(NOTE), folder, &lines)
}

/// A line as the list has it, as far as it names files.
fn line(ListedClip { file, thumbnail }: &ListedClip) -> Vec<u8> {
    let path = |name: &String| format!("{CLIPS}/{name}");
    let line = serde_json::json!({ "file": path(file), "thumbnail": thumbnail.as_ref().map(path) });
    format!("{line}\n").into_bytes()
}

/// Deletes the noted clips, and returns how many these were. Clips that the list names stay: the
/// process died before it wrote the list.
pub(super) fn complete(folder: &Path, list: &ClipList) -> Result<u64, RecordError> {
    // A process that died while it wrote the note had changed nothing else.
    let _ = fs::remove_file(folder.join(NOTE_PART));
    let path = folder.join(NOTE);
    let cannot_read = |source| RecordError::Read { path: path.clone(), source };
    let noted = match safe_file::read(&path) {
        Ok(noted) => noted,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
        Err(error) => return Err(cannot_read(error)),
    };
    let (doomed, _, _) = read_lines(&noted, |_| Ok(())).map_err(cannot_read)?;
    let listed: HashSet<String> = list.read()?.into_iter().map(|listed| listed.file).collect();
    let (mut deleted, mut left) = (0, Vec::new());
    for doomed in doomed.into_iter().filter(|doomed| !listed.contains(&doomed.file)) {
        let ListedClip { file, thumbnail } = &doomed;
        // The thumbnail first: one without its clip would belong to nothing.
        let thumbnail = thumbnail
            .as_ref()
            .map_or(Ok(false), |thumbnail| durable::remove(&folder.join(thumbnail)));
        match thumbnail.and_then(|_| durable::remove(&folder.join(file))) {
            Ok(was_there) => deleted += u64::from(was_there),
            // A folder of this name, for example: it stays, and is no clip of the list any more.
            Err(error) => {
                warn!(%file, error = &error as &dyn std::error::Error, "cannot delete a clip, which is tried again at the next start");
                left.push(doomed);
            }
        }
    }
    durable::sync_folder(folder)?;
    // A clip of the same name may come next: the note must not outlive it. One that is still there
    // would be taken for a clip that no process had listed.
    if left.is_empty() {
        durable::remove(&path)?;
        durable::sync_folder(folder)?;
    } else {
        note(folder, &left)?;
    }
    Ok(deleted)
}
