//! The models of a lambda, as they are passed to the process.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;

use gleaner_artifacts::{BuiltEngine, DerivedEntry, StoreError};
use gleaner_base::programs::cache_dir;
use gleaner_base::{Exit, Failure, PlainFile, chain, hex};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::ModelSpec;
use gleaner_protocol::inference::{GrantedModel, ModelEngine, ModelFile};
use sha2::{Digest, Sha256};

/// A model that the process may load.
#[derive(Clone)]
pub(super) struct PassedModel {
    pub(super) model: ModelFile,
    pub(super) file: Arc<File>,
    /// Entry with its engine.
    pub(super) engine: Option<Arc<File>>,
}

/// Returns a model of a manifest, as its lambda may use it.
pub(super) fn granted(model: &ModelSpec) -> GrantedModel {
    GrantedModel {
        name: model.name.to_string(),
        sha256: model.sha256.to_string(),
        providers: model.providers.clone(),
        threads: u32::try_from(model.threads).ok(),
        refused: None,
    }
}

impl PassedModel {
    /// Opens the file of a model in the build `build`, and its engine if there is one.
    pub(super) fn open(model: &ModelSpec, build: &Path) -> Result<Self, Failure> {
        let file = PlainFile::inside(build, model.file.as_path(), FILE_MAX);
        let file = file.map(PlainFile::into_file).map_err(|error| {
            let message =
                format!("cannot open `{}`, the file of model `{}`", model.file, model.name);
            Failure::caused_by(Exit::Usage, message, &error)
                .with_help("build the lambda again: gleaner build DIR")
        })?;
        let (sha256, path) = (model.sha256.to_string(), model.file.to_string());
        let (engine, entry) = match stored_engine(&sha256) {
            Ok(Some(entry)) => (ModelEngine::Attached, Some(entry)),
            Ok(None) => (ModelEngine::None, None),
            Err(reason) => (ModelEngine::Refused(reason), None),
        };
        let (file, entry) = (Arc::new(file), entry.map(Arc::new));
        Ok(Self { model: ModelFile { sha256, path, engine }, file, engine: entry })
    }

    /// Returns why the model is refused for a lambda, if its file has another digest than stated:
    /// models are shared by their digests, so another lambda's would not be loaded.
    pub(super) fn mismatch(&self, lambda: &str) -> Option<String> {
        let ModelFile { sha256: stated, path, .. } = &self.model;
        let cause = match self.digest() {
            Ok(found) if found == *stated => return None,
            Ok(found) => format!("has the SHA-256 {found}, and the manifest states {stated}"),
            Err(error) => format!("cannot be read: {error}"),
        };
        Some(format!(
            "model `{path}` of lambda `{lambda}` is refused: the file {cause}; correct it, or \
             `sha256` in lambda.toml, and build the lambda again: gleaner build DIR"
        ))
    }

    /// Computes the digest of the file, which takes seconds for a large one. All that have
    /// the file share its offset, so it is not used.
    fn digest(&self) -> io::Result<String> {
        let (mut sha256, mut piece, mut at) = (Sha256::new(), vec![0; 64 << 10], 0);
        while at < FILE_MAX.bytes()
            && let length @ 1.. = self.file.read_at(&mut piece, at)?
        {
            sha256.update(&piece[..length]);
            at += length as u64;
        }
        Ok(hex(&sha256.finalize()))
    }
}

/// Opens the entry with the engine of the model with this SHA-256, if there is one. Otherwise
/// returns the reason why it must not be used.
fn stored_engine(sha256: &str) -> Result<Option<File>, String> {
    let store = cache_dir().map_err(|error| chain(&error))?;
    match DerivedEntry::of(&store, BuiltEngine::key(sha256)).open() {
        // There is no store yet.
        Err(StoreError::Read { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
            Ok(None)
        }
        found => found.map_err(|error| chain(&error)),
    }
}
