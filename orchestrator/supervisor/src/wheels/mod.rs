//! Python environments of deployed lambdas, made of the wheels in their revisions.
//!
//! A revision has the wheels of its lambda in `build/wheels/`, so its signature covers them. `name`
//! compares their tags with an `interpreter`, `archive` reads them, and `environment` unpacks them
//! beside the build, and compares the result with them before each start. The digests for that
//! come from the wheels themselves. Nothing here opens a socket, and no code of a wheel runs.

mod archive;
mod environment;
mod error;
mod interpreter;
#[cfg(test)]
mod made_wheel;
mod name;

use std::path::{Path, PathBuf};

pub use archive::check;
pub use environment::{PreparedPython, prepare};
pub use error::WheelError;
use gleaner_lambda::{BuildDir, LayoutError};
pub use interpreter::Interpreter;
pub use name::WheelName;

/// The folder of the wheels in a build.
pub const WHEELS: &str = "wheels";

/// Returns the paths of the wheels of a build, in it and sorted.
///
/// # Errors
///
/// Those of [`BuildDir::files`].
pub fn wheels_of(build: &BuildDir) -> Result<Vec<PathBuf>, LayoutError> {
    // One with an ending in capitals is refused by its name: it must not be missing silently.
    let is_wheel = |path: &PathBuf| {
        path.parent() == Some(Path::new(WHEELS))
            && path.extension().is_some_and(|it| it.eq_ignore_ascii_case("whl"))
    };
    Ok(build.files()?.into_iter().filter(is_wheel).collect())
}
