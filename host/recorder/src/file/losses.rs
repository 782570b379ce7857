//! `losses.jsonl`: a line for each loss. All losses are written here, so that lines stay complete.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use gleaner_base::safe_file;
use gleaner_protocol::link::Loss;

use crate::error::RecordError;

#[derive(Debug)]
pub struct LossList {
    path: PathBuf,
    /// One line at a time.
    turn: Mutex<()>,
}

impl LossList {
    /// Returns the list of losses in `folder`, which may not exist yet.
    pub(super) fn of(folder: &Path) -> LossList {
        LossList { path: folder.join("losses.jsonl"), turn: Mutex::default() }
    }

    /// Appends a line and syncs it. After an error, [`RecordError::Write`], the list is
    /// unchanged.
    pub fn note(&self, loss: &Loss) -> Result<(), RecordError> {
        let failed = |source| RecordError::Write { path: self.path.clone(), source };
        let mut line = serde_json::to_vec(loss).expect("a loss is plain data");
        line.push(b'\n');
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let mut file = safe_file::append(&self.path).map_err(failed)?;
        let before = file.metadata().map_err(failed)?.len();
        file.write_all(&line).and_then(|()| file.sync_data()).map_err(|error| {
            // A torn line would corrupt the next one.
            let _ = file.set_len(before);
            failed(error)
        })
    }
}
