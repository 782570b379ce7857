//! Compiles the component of a revision before it runs, so that its start does not wait for it.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure, format_duration};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_lambda::{BuildDir, Manifest};

use crate::bounded_process;

/// Time for one component. `gleaner-compile` limits its CPU time to two minutes; a machine that is
/// busy, or a disk that does not answer, takes longer.
const LIMIT: Duration = Duration::from_secs(600);

/// Compiles the component in the folder of a revision, if it has one, into the store `cache`, in a
/// process of its own. Does nothing if its native code is there already. The failure is that of
/// `gleaner-compile`, or one if it does not end in time.
pub(crate) fn component(folder: &Path, cache: &Path) -> Result<(), Failure> {
    let build = BuildDir::of(folder);
    let manifest = Manifest::load(build.path())?;
    if manifest.lambda.kind != LambdaKind::Wasm {
        return Ok(());
    }
    let program = InstalledPrograms::find()?.program("gleaner-compile")?;
    let cannot = |error: &dyn std::error::Error| {
        let action = format!("cannot start `{}`", program.display());
        Failure::caused_by(Exit::Internal, action, error)
    };
    let mut command = Command::new(&program);
    command
        .arg(build.entry_path(&manifest))
        .arg("--cache")
        // As the runtime does, for which the supervisor sets `XDG_CACHE_HOME`.
        .arg(cache.join("gleaner"))
        .args(manifest.lambda.deterministic.then_some("--deterministic"));
    let output = bounded_process::output(&mut command, LIMIT).map_err(|error| cannot(&error))?;
    let Some(output) = output else {
        let (name, limit) = (&manifest.lambda.name, format_duration(LIMIT));
        let message = format!("compiling lambda `{name}` took longer than {limit}");
        let mut failure = Failure::new(Exit::Unreachable, message);
        failure.causes = vec!["the process was killed; what ran before goes on".to_owned()];
        return Err(failure.with_help(
            "deploy it again when the machine is less busy; if that does not help, check the disk \
             with the state folder, or make the component smaller",
        ));
    };
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
