//! Compiles the component of a revision before it runs, so that its start does not wait for it.

use std::path::Path;
use std::process::{Command, Stdio};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_parts::Parts;

/// Compiles the component in the folder of a revision, if it has one, into the store `cache`, in a
/// process of its own. Does nothing if its native code is there already.
///
/// # Errors
///
/// The failure of `gleaner-compile`.
pub(crate) fn component(folder: &Path, cache: &Path) -> Result<(), Failure> {
    let build = BuildDir::of(folder);
    let manifest = Manifest::load(build.path())?;
    if manifest.lambda.kind != LambdaKind::Wasm {
        return Ok(());
    }
    let program = Parts::find()?.program("gleaner-compile")?;
    let cannot = |error: &dyn std::error::Error| {
        let action = format!("cannot start `{}`", program.display());
        Failure::caused_by(Exit::Internal, action, error)
    };
    let output = Command::new(&program)
        .arg(build.entry_path(&manifest))
        .arg("--cache")
        // As the runtime does, for which the supervisor sets `XDG_CACHE_HOME`.
        .arg(cache.join("gleaner"))
        .args(manifest.lambda.deterministic.then_some("--deterministic"))
        .stdin(Stdio::null())
        .output()
        .map_err(|error| cannot(&error))?;
    if output.status.success() {
        return Ok(());
    }
    let exit = output.status.code().and_then(Exit::from_code).unwrap_or(Exit::Internal);
    let text = String::from_utf8_lossy(&output.stderr);
    Err(Failure::parse(&text, exit).unwrap_or_else(|| {
        let name = &manifest.lambda.name;
        let mut failure = Failure::new(exit, format!("cannot compile lambda `{name}`"));
        failure.causes = vec![gleaner_base::excerpt(&text), output.status.to_string()];
        failure
    }))
}
