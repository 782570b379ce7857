//! Entries with an engine of TensorRT: the code that it made of a model for one GPU.
//!
//! A model has one entry. The content begins with a line that names everything on the machine that
//! the engine depends on, its runtime: a reader uses the engine only on an equal one.

use std::path::Path;

use super::{DerivedEntry, DerivedKey, DerivedKind, StoreError};

/// Maximum length of the name of a runtime, in bytes.
const RUNTIME_BYTES: usize = 4096;

/// Format of the content, as a part of the key.
const SETTINGS: &str = "a line with the runtime, then a model of ONNX Runtime with the engine, 1";

/// An engine, as read from its entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuiltEngine {
    /// Name of the runtime that it was built for.
    pub runtime: String,
    /// A model of ONNX Runtime that contains the engine.
    pub model: Vec<u8>,
}

impl BuiltEngine {
    /// Returns the key of the engine of a model, whose file has the SHA-256 `sha256`, in lower-case
    /// hexadecimal digits.
    pub fn key(sha256: &str) -> DerivedKey {
        DerivedKey::of(DerivedKind::Engine, SETTINGS, sha256.as_bytes())
    }

    /// Puts the engine `model` of the model with this SHA-256 into `store`, in place of one that is
    /// there.
    ///
    /// # Errors
    ///
    /// [`StoreError::Write`], also for a runtime without a usable name.
    pub fn put(store: &Path, sha256: &str, runtime: &str, model: &[u8]) -> Result<(), StoreError> {
        let entry = DerivedEntry::of(store, Self::key(sha256));
        if runtime.len() > RUNTIME_BYTES || runtime.contains(char::is_control) {
            let reason = format!("its runtime has no name of one line and {RUNTIME_BYTES} bytes");
            return Err(entry.refused(reason));
        }
        entry.put(&[runtime.as_bytes(), b"\n", model])
    }

    /// Parses the verified content of an entry; `None` if it is none of an engine.
    pub fn parse(mut content: Vec<u8>) -> Option<Self> {
        let end = content.iter().take(RUNTIME_BYTES + 1).position(|byte| *byte == b'\n')?;
        let runtime = std::str::from_utf8(&content[..end]).ok()?.to_owned();
        content.drain(..=end);
        Some(Self { runtime, model: content })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{StoreLookup, make_store};

    #[test]
    fn an_engine_is_read_back_with_its_runtime_and_a_new_one_replaces_it() {
        let folder = tempfile::tempdir().unwrap();
        let store = folder.path().join("store");
        make_store(&store).unwrap();
        let [one, other] = ["1", "2"].map(|digit| digit.repeat(64));
        let found = |sha256: &str| match DerivedEntry::of(&store, BuiltEngine::key(sha256)).read() {
            Ok(StoreLookup::Content(content)) => BuiltEngine::parse(content),
            Ok(StoreLookup::Nothing) => None,
            other => panic!("{other:?}"),
        };
        let engine = |runtime: &str, model: &[u8]| {
            Some(BuiltEngine { runtime: runtime.to_owned(), model: model.to_vec() })
        };
        assert_eq!(found(&one), None);
        BuiltEngine::put(&store, &one, "Orin, driver 1", b"engine\n1").unwrap();
        assert_eq!(found(&one), engine("Orin, driver 1", b"engine\n1"));
        assert_eq!(found(&other), None);
        BuiltEngine::put(&store, &one, "", b"").unwrap();
        assert_eq!(found(&one), engine("", b""));
        for runtime in ["two\nlines", &"x".repeat(RUNTIME_BYTES + 1)] {
            let error = BuiltEngine::put(&store, &one, runtime, b"engine").unwrap_err();
            let cause = std::error::Error::source(&error).unwrap().to_string();
            assert!(cause.contains("no name of one line"), "{cause}");
        }
        assert_eq!(found(&one), engine("", b""));
        for content in [&b""[..], b"no line", b"\xff\nengine", &[b'x'; RUNTIME_BYTES + 2]] {
            assert_eq!(BuiltEngine::parse(content.to_vec()), None);
        }
    }
}
