//! `fuzz-seeds FOLDER`: writes the seeds and dictionaries of all targets to a folder.

use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(folder) = std::env::args_os().nth(1) else {
        eprintln!("usage: fuzz-seeds FOLDER");
        return ExitCode::from(2);
    };
    match gleaner_fuzz::seeds::write(Path::new(&folder)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!(
                "error: cannot write to `{}`\n  cause: {error}",
                Path::new(&folder).display()
            );
            ExitCode::FAILURE
        }
    }
}
