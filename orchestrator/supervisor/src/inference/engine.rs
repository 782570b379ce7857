//! Engines of models in the store.

use std::fs::File;
use std::io;

use gleaner_artifacts::{BuiltEngine, DerivedEntry, StoreError};
use gleaner_base::chain;
use gleaner_parts::cache_dir;

/// Opens the entry with the engine of the model with this SHA-256, if there is one. Otherwise
/// returns the reason why it must not be used.
pub(super) fn stored(sha256: &str) -> Result<Option<File>, String> {
    let store = cache_dir().map_err(|error| chain(&error))?;
    match DerivedEntry::of(&store, BuiltEngine::key(sha256)).open() {
        // There is no store yet.
        Err(StoreError::Read { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
            Ok(None)
        }
        found => found.map_err(|error| chain(&error)),
    }
}
