//! `gleaner build DIR`: a lambda's sources become its build folder, which every other command uses.
//!
//! `component` compiles Rust, in a `sandbox` if that is asked for, `folder` puts everything
//! together beside the old build and swaps the two, so that a build that fails leaves the old one
//! as it was. Which files make up a lambda is said by `gleaner_lambda::Sources`. Nothing here runs
//! a lambda or looks into a component.

mod component;
mod error;
mod folder;
mod sandbox;

use std::fs::File;
use std::path::Path;
use std::time::SystemTime;

use gleaner_base::{ByteSize, Exit, Failure, PlainFile};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::Kind;
use gleaner_lambda::{BuildDir, LayoutError, Manifest, SOURCE_MAX, Sources};
use gleaner_report::words::size;

use error::BuildError;
use folder::{Built, Partial};

use crate::say::say;

/// Builds the lambda in `dir` and says so. If it is `sandboxed`, code of its author runs in a jail
/// meanwhile.
pub(crate) fn run(dir: &Path, sandboxed: bool) -> Result<Exit, Failure> {
    // A change that comes while we build makes the build older than its source, as it should.
    let started = SystemTime::now();
    let manifest = Manifest::load(dir)?;
    let built = build(dir, &manifest, started, sandboxed).map_err(|error| {
        Failure::because(
            format!("cannot build lambda `{}` in `{}`", manifest.lambda.name, dir.display()),
            &error,
        )
    })?;
    let (path, files) = (BuildDir::of(dir), built.files);
    let files = if files == 1 { "1 file".to_owned() } else { format!("{files} files") };
    say(&format!(
        "built {} ({files}, {})\n{}",
        path.path().display(),
        size(built.bytes),
        note(&manifest)
    ))?;
    Ok(Exit::Ok)
}

fn build(
    dir: &Path,
    manifest: &Manifest,
    started: SystemTime,
    sandboxed: bool,
) -> Result<Built, BuildError> {
    check_entry(manifest)?;
    // Two builds of one lambda take turns. Where a folder cannot be locked, they are on their own.
    let turn = File::open(dir).and_then(|folder| folder.lock().map(|()| folder));

    let mut partial = Partial::begin(dir)?;
    let sources = Sources::of(dir, manifest).map_err(BuildError::Sources)?;
    check_named(dir, manifest)?;
    if manifest.lambda.kind == Kind::Wasm {
        let component = component::compile(dir, sandboxed)?;
        partial.add(&component.path, component.opened, manifest.lambda.entry.as_path())?;
    }
    for source in &sources.copied {
        let opened = PlainFile::inside(dir, source, longest(manifest, source));
        partial.add(&dir.join(source), opened, source)?;
    }
    let built = partial.finish(started)?;

    drop(turn);
    match BuildDir::check_fresh(dir) {
        Ok(_) => Ok(built),
        Err(LayoutError::Older { source_file, .. }) => Err(BuildError::Changed { source_file }),
        Err(error) => Err(BuildError::Layout(error)),
    }
}

/// The bound of a file that a build copies.
fn longest(manifest: &Manifest, source: &Path) -> ByteSize {
    let is_model = manifest.models.iter().any(|model| model.file.as_path() == source);
    if is_model { FILE_MAX } else { SOURCE_MAX }
}

/// What a clip of this lambda will not be able to prove, if there is anything.
fn note(manifest: &Manifest) -> String {
    let Some(record) = &manifest.record else { return String::new() };
    let unrecorded = manifest
        .inputs
        .iter()
        .map(|input| &input.topic)
        .filter(|topic| !record.topics.contains(topic));
    let topics = unrecorded.map(|topic| format!("`{topic}`")).collect::<Vec<_>>().join(", ");
    match topics.is_empty() {
        true => String::new(),
        false => {
            format!(
                "note: [record] leaves out {topics}, which the lambda reads: its clips cannot be verified alone\n"
            )
        }
    }
}

/// The entry has its kind's extension, so that it cannot be the manifest or a message definition.
fn check_entry(manifest: &Manifest) -> Result<(), BuildError> {
    let entry = &manifest.lambda.entry;
    let extension = match manifest.lambda.kind {
        Kind::Wasm => "wasm",
        Kind::Python => "py",
    };
    if entry.as_path().extension().is_some_and(|found| found == extension) {
        return Ok(());
    }
    Err(BuildError::EntryName { entry: entry.to_string(), kind: manifest.lambda.kind, extension })
}

/// What the manifest names is there, except for the entry that a compiler makes.
fn check_named(dir: &Path, manifest: &Manifest) -> Result<(), BuildError> {
    let entry = (manifest.lambda.kind == Kind::Python)
        .then(|| (manifest.lambda.entry.as_path(), "`entry`"));
    let models =
        manifest.models.iter().map(|model| (model.file.as_path(), "`file` of a [[model]]"));
    // What is there and no file is refused by name when it is copied.
    match entry.into_iter().chain(models).find(|(file, _)| !dir.join(file).exists()) {
        Some((file, named_by)) => Err(BuildError::Missing { path: dir.join(file), named_by }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
