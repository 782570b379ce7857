//! `gleaner build DIR`: a lambda's sources become its build folder, which every other command uses.
//!
//! `component` compiles Rust, `python` chooses the files of a Python lambda, `folder` puts everything together beside
//! the old build and swaps the two, so that a build that fails leaves the old one as it was. Nothing here runs a
//! lambda or looks into a component.

mod component;
mod error;
mod folder;
mod python;

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::time::SystemTime;

use gleaner_protocol::manifest::Kind;
use gleaner_protocol::{BuildDir, Exit, Failure, LayoutError, Manifest};

use error::BuildError;
use folder::{Built, Partial};

/// Builds the lambda in `dir` and says so.
pub(crate) fn run(dir: &Path) -> Result<Exit, Failure> {
    // A change that comes while we build makes the build older than its source, as it should.
    let started = SystemTime::now();
    let manifest = Manifest::load(dir)?;
    let built = build(dir, &manifest, started).map_err(|error| {
        Failure::because(format!("cannot build lambda `{}` in `{}`", manifest.lambda.name, dir.display()), &error)
    })?;
    let (path, files, kb) = (BuildDir::of(dir), built.files, built.bytes.div_ceil(1000));
    let files = if files == 1 { "1 file".to_owned() } else { format!("{files} files") };
    // Whoever reads this may have gone; the build is there.
    let _ = writeln!(io::stdout(), "built {} ({files}, {kb} kB)", path.path().display());
    Ok(Exit::Ok)
}

fn build(dir: &Path, manifest: &Manifest, started: SystemTime) -> Result<Built, BuildError> {
    check_entry(manifest)?;
    // Two builds of one lambda take turns. Where a folder cannot be locked, they are on their own.
    let turn = File::open(dir).and_then(|folder| folder.lock().map(|()| folder));

    let mut partial = Partial::begin(dir)?;
    let entry = manifest.lambda.entry.as_path();
    match manifest.lambda.kind {
        Kind::Wasm => partial.add(&component::compile(dir)?, entry)?,
        Kind::Python => {
            let sources = python::sources(dir)?;
            if !dir.join(entry).is_file() {
                return Err(BuildError::Missing { path: dir.join(entry), named_by: "`entry`" });
            }
            for source in sources {
                partial.add(&dir.join(&source), &source)?;
            }
            partial.add(&dir.join(entry), entry)?;
        }
    }
    for model in &manifest.models {
        let file = model.file.as_path();
        if !dir.join(file).is_file() {
            return Err(BuildError::Missing { path: dir.join(file), named_by: "`file` of a [[model]]" });
        }
        partial.add(&dir.join(file), file)?;
    }
    partial.add_messages()?;
    let built = partial.finish(started)?;

    drop(turn);
    match BuildDir::check_fresh(dir) {
        Ok(_) => Ok(built),
        Err(LayoutError::Older { source_file, .. }) => Err(BuildError::Changed { source_file }),
        Err(error) => Err(BuildError::Layout(error)),
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

#[cfg(test)]
mod tests;
