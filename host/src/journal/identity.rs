//! Identifies the lambda that made a decision: files with digests, config, engine and machine.

use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Explain, PlainFile, hex};
use gleaner_journal::{FileDigest, JournalHeader, JournalInput, TimeRange};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::{ConfigValue, Manifest, ScheduleSpec};
use gleaner_lambda::{BuildDir, LayoutError};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use crate::input::Remap;

#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    #[error("cannot take the digest of `{}`", path.display())]
    Digest { path: PathBuf, source: io::Error },
    #[error(transparent)]
    Build(#[from] LayoutError),
}

impl Explain for IdentityError {
    fn help(&self) -> Option<String> {
        match self {
            Self::Digest { .. } => None,
            Self::Build(error) => error.help(),
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Digest { .. } => Exit::Internal,
            Self::Build(error) => error.exit(),
        }
    }
}

/// Everything that a decision of a lambda can depend on, except its samples.
pub struct LambdaIdentity<'a> {
    pub manifest: &'a Manifest,
    pub build: &'a BuildDir,
    /// All of `[config]`, with overrides.
    pub config: &'a [(String, ConfigValue)],
    pub remaps: &'a [Remap],
    /// The engine that runs it, with its version.
    pub engine: String,
    /// The clock of the journal's times.
    pub clock: &'a str,
    /// The part of a drive that it receives.
    pub part: TimeRange,
}

impl LambdaIdentity<'_> {
    /// Builds the header of a journal.
    pub fn header(self) -> Result<JournalHeader, IdentityError> {
        let Self { manifest, build, config, remaps, engine, clock, part } = self;
        let lambda = &manifest.lambda;
        let event = match &manifest.schedule {
            ScheduleSpec::Event { input, .. } => {
                manifest.inputs.iter().position(|known| known.name == *input)
            }
            ScheduleSpec::Periodic { .. } => None,
        };
        Ok(JournalHeader {
            gleaner: env!("CARGO_PKG_VERSION").to_owned(),
            engine,
            machine: std::env::consts::ARCH.to_owned(),
            lambda: lambda.name.to_string(),
            version: lambda.version.to_string(),
            kind: lambda.kind,
            files: build_digests(build)?,
            models: manifest.models.iter().map(model).collect(),
            manifest: manifest_digest(manifest),
            limits: manifest.limits,
            inputs: manifest.inputs.iter().map(|input| journal_input(input, remaps)).collect(),
            event_input: event,
            config: config
                .iter()
                .map(|(key, value)| (key.clone(), json!(value)))
                .collect::<Map<_, _>>(),
            remaps: remaps.iter().map(|remap| (remap.from.clone(), remap.to.clone())).collect(),
            clock: clock.to_owned(),
            part,
            wakes_before: 0,
        })
    }
}

/// Digest of the parts of a manifest on which a decision can depend. Limits are in the header
/// themselves.
fn manifest_digest(manifest: &Manifest) -> String {
    let mut json = manifest.to_json();
    if let Some(table) = json.as_object_mut() {
        table.remove("record");
        table.remove("limits");
        table.remove("demand");
    }
    without_descriptions(&mut json);
    hex(&Sha256::digest(json.to_string()))
}

fn without_descriptions(json: &mut Value) {
    match json {
        Value::Object(table) => {
            table.remove("description");
            table.values_mut().for_each(without_descriptions);
        }
        Value::Array(items) => items.iter_mut().for_each(without_descriptions),
        _ => {}
    }
}

fn model(model: &gleaner_lambda::manifest::ModelSpec) -> FileDigest {
    FileDigest { path: model.file.to_string(), bytes: 0, sha256: model.sha256.to_string() }
}

fn journal_input(input: &gleaner_lambda::manifest::InputSpec, remaps: &[Remap]) -> JournalInput {
    let topic = input.topic.as_str();
    JournalInput {
        name: input.name.to_string(),
        topic: topic.to_owned(),
        wire_topic: Remap::apply(remaps, topic).to_owned(),
        type_name: input.type_name.to_string(),
    }
}

/// Digests of all files of a build, by their paths in it.
fn build_digests(build: &BuildDir) -> Result<Vec<FileDigest>, IdentityError> {
    build.files()?.iter().map(|path| digest_of_file(build, path)).collect()
}

fn digest_of_file(build: &BuildDir, path: &Path) -> Result<FileDigest, IdentityError> {
    let failed = |source| IdentityError::Digest { path: build.path().join(path), source };
    let mut file = PlainFile::inside(build.path(), path, FILE_MAX).map_err(failed)?;
    let mut digest = Sha256::new();
    let bytes = io::copy(&mut file, &mut digest).map_err(failed)?;
    Ok(FileDigest {
        path: path.to_string_lossy().into_owned(),
        bytes,
        sha256: hex(&digest.finalize()),
    })
}
