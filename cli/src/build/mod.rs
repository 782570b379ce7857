//! `gleaner build DIR`: builds a lambda's folder `build`, which every other command uses.
//!
//! `component` compiles Rust, in a `sandbox` on request. `wheels` fetches the packages of a Python
//! lambda that `requirements` names, by `pip`. `folder` collects the files beside the old
//! build and then replaces it, so that a failed build leaves the old one unchanged. The files of a
//! lambda are listed by `gleaner_lambda::Sources`. Nothing here runs a lambda or parses a
//! component.

mod component;
mod error;
mod folder;
mod pip;
mod requirements;
mod sandbox;
mod wheels;

use std::fs::File;
use std::path::Path;
use std::time::SystemTime;

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, excerpt};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::LambdaKind;
use gleaner_lambda::{BuildDir, LayoutError, Manifest, SOURCE_MAX, Sources};
use gleaner_report::format::{counted, size};

use error::BuildError;
use folder::{Built, PartialBuild};

use crate::args::BuildArgs;
use crate::output::print;

pub(crate) fn run(args: &BuildArgs) -> Result<Exit, Failure> {
    let dir = &*args.lambda;
    // A source that is changed during the build is then newer than the build.
    let started = SystemTime::now();
    let manifest = Manifest::load(dir)?;
    let built = build(args, &manifest, started).map_err(|error| {
        Failure::because(
            format!("cannot build lambda `{}` in `{}`", manifest.lambda.name, dir.display()),
            &error,
        )
    })?;
    let (path, files) = (BuildDir::of(dir), counted(built.files, "file"));
    print(&format!(
        "built {} ({files}, {})\n{}{}{}",
        path.path().display(),
        size(built.bytes),
        note(&manifest),
        left_out(dir, &manifest),
        wheels::note(dir, &path)
    ))?;
    Ok(Exit::Ok)
}

fn build(args: &BuildArgs, manifest: &Manifest, started: SystemTime) -> Result<Built, BuildError> {
    let dir = &*args.lambda;
    check_entry(manifest)?;
    // The lock serialises builds of one lambda, where folders can be locked.
    let lock = File::open(dir).and_then(|folder| folder.lock().map(|()| folder));

    let mut partial = PartialBuild::begin(dir)?;
    let sources = Sources::of(dir, manifest).map_err(BuildError::Sources)?;
    check_named(dir, manifest, &sources)?;
    if manifest.lambda.kind == LambdaKind::Wasm {
        let component = component::compile(dir, args.sandboxed)?;
        partial.add(&component.path, component.opened, manifest.lambda.entry.as_path())?;
    } else {
        wheels::add(args, &mut partial)?;
    }
    for source in &sources.copied {
        let opened = PlainFile::inside(dir, source, max_size(manifest, source));
        partial.add(&dir.join(source), opened, source)?;
    }
    let built = partial.finish(started)?;

    drop(lock);
    match BuildDir::check_fresh(dir) {
        Ok(_) => Ok(built),
        Err(LayoutError::Older { source_file, .. }) => Err(BuildError::Changed { source_file }),
        Err(error) => Err(BuildError::Layout(error)),
    }
}

/// Returns the maximum size of a file that a build copies.
fn max_size(manifest: &Manifest, source: &Path) -> ByteSize {
    let is_model = manifest.models.iter().any(|model| model.file.as_path() == source);
    let is_data = || manifest.lambda.files.iter().any(|data| source.starts_with(data.as_path()));
    if is_model || is_data() { FILE_MAX } else { SOURCE_MAX }
}

/// Returns a note if clips of this lambda cannot be verified alone; else an empty text.
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
        false => format!(
            "note: [record] lacks {topics}, which the lambda reads: its clips cannot be verified \
             alone\n"
        ),
    }
}

/// Returns a note with the first files that the build of a Python lambda lacks; else an empty text.
fn left_out(dir: &Path, manifest: &Manifest) -> String {
    let found = Sources::of(dir, manifest).and_then(|sources| sources.left_out(dir));
    // The build is complete, with or without a note.
    let paths = found.unwrap_or_default();
    if paths.is_empty() || manifest.lambda.kind != LambdaKind::Python {
        return String::new();
    }
    let shown: Vec<_> = paths.iter().take(5).map(|path| excerpt(&path.to_string_lossy())).collect();
    let (more, shown) = (paths.len() - shown.len(), shown.join("`, `"));
    let more = if more == 0 { String::new() } else { format!(" and {more} more") };
    format!("note: not built in: `{shown}`{more}; add data of the lambda to `files` of [lambda]\n")
}

/// Checks that the entry has the extension of its kind, so that it cannot be the manifest or a
/// message definition.
fn check_entry(manifest: &Manifest) -> Result<(), BuildError> {
    let entry = &manifest.lambda.entry;
    let extension = match manifest.lambda.kind {
        LambdaKind::Wasm => "wasm",
        LambdaKind::Python => "py",
    };
    if entry.as_path().extension().is_some_and(|found| found == extension) {
        return Ok(());
    }
    Err(BuildError::EntryName { entry: entry.to_string(), kind: manifest.lambda.kind, extension })
}

/// Checks that the files in the manifest exist, except for the entry that the compiler makes.
fn check_named(dir: &Path, manifest: &Manifest, sources: &Sources) -> Result<(), BuildError> {
    let entry = (manifest.lambda.kind == LambdaKind::Python)
        .then(|| (manifest.lambda.entry.as_path(), "`entry`"));
    let models =
        manifest.models.iter().map(|model| (model.file.as_path(), "`file` of a [[model]]"));
    let data = manifest.lambda.files.iter().map(|file| (file.as_path(), "`files` of [lambda]"));
    let is_copied = |named: &Path| sources.copied.iter().any(|file| file.starts_with(named));
    for (file, named_by) in entry.into_iter().chain(models).chain(data) {
        let path = dir.join(file);
        // Of a folder, any file. What exists but is not a file is refused when it is copied.
        let path = if path.is_dir() && !is_copied(file) { path.join("*") } else { path };
        if !path.exists() {
            return Err(BuildError::Missing { path, named_by });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
