//! `clips/.replaced`: lists the clips that a replay will delete, before they leave the list of
//! clips. The file is removed once they are deleted.

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
/// Name of the file while it is written.
const NOTE_PART: &str = ".replaced.part";

pub(super) fn note(folder: &Path, clips: &[ListedClip]) -> Result<(), RecordError> {
    if clips.is_empty() {
        return Ok(());
    }
    let lines: Vec<u8> = clips.iter().flat_map(line).collect();
    durable::write(&folder.join(NOTE_PART), &folder.join(NOTE), folder, &lines)
}

/// Formats a line of the list, with file names only.
fn line(ListedClip { file, thumbnail }: &ListedClip) -> Vec<u8> {
    let path = |name: &String| format!("{CLIPS}/{name}");
    let line = serde_json::json!({ "file": path(file), "thumbnail": thumbnail.as_ref().map(path) });
    format!("{line}\n").into_bytes()
}

/// Deletes the noted clips, and returns their number. Listed clips stay: the process died before it
/// wrote the list.
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
    let (clips, _, _) = read_lines(&noted, |_| Ok(())).map_err(cannot_read)?;
    let listed: HashSet<String> = list.read()?.into_iter().map(|listed| listed.file).collect();
    let (mut deleted, mut left) = (0, Vec::new());
    for clip in clips.into_iter().filter(|clip| !listed.contains(&clip.file)) {
        let ListedClip { file, thumbnail } = &clip;
        // The thumbnail first, so that none is left without its clip.
        let thumbnail = thumbnail
            .as_ref()
            .map_or(Ok(false), |thumbnail| durable::remove(&folder.join(thumbnail)));
        match thumbnail.and_then(|_| durable::remove(&folder.join(file))) {
            Ok(was_there) => deleted += u64::from(was_there),
            // For example a folder of this name: it stays, but is not listed any more.
            Err(error) => {
                warn!(
                    %file,
                    error = &error as &dyn std::error::Error,
                    "cannot delete a clip; retried at the next start"
                );
                left.push(clip);
            }
        }
    }
    durable::sync_folder(folder)?;
    // A clip of the same name may come next, so the note must not outlive it. A clip that is still
    // there would be taken for one that was never listed.
    if left.is_empty() {
        durable::remove(&path)?;
        durable::sync_folder(folder)?;
    } else {
        note(folder, &left)?;
    }
    Ok(deleted)
}
