//! The program `gleaner-supervisor`: runs what the orchestrator wants, and goes on without it.
//!
//! - `connection`: the orchestrator's requests, and reports to it.
//! - `board`: the events of a run become the status, and records of the spool `events`.
//! - `serve`: the loop.
//!
//! It has no network and no keys, and runs no code but that of its programs. Its requests come
//! over one socket, from a process of the same user.

mod connection;
mod serve;
mod status_board;

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::process::ExitCode;

use gleaner_base::{Exit, Failure};

const HELP: &str = "Starts and supervises the processes of a vehicle

`gleaner-orchestrator` starts it; see docs/vehicle.md

Usage: gleaner-supervisor

Options:
  -h, --help     Print help
  -V, --version  Print version";

/// Runs the program `gleaner-supervisor`. Its standard input is a socket that listens for the
/// orchestrator, and its standard output a file whose lock it holds while it runs.
pub fn main() -> ExitCode {
    if let Some(answer) = std::env::args_os().nth(1).and_then(|it| answer(it.to_str()?)) {
        println!("{answer}");
        return Exit::Ok.into();
    }
    // Fails if it has a session already. A signal to that of its starter does not reach it.
    let _ = rustix::process::setsid();
    // Each lambda takes several.
    gleaner_base::raise_open_files();
    let ended = listener().and_then(serve::serve);
    if let Err(failure) = &ended {
        eprintln!("{failure}");
    }
    ended.map_or_else(|failure| failure.exit.code(), |()| Exit::Ok.code()).into()
}

/// Returns the answer to the only arguments that it has.
fn answer(argument: &str) -> Option<String> {
    match argument {
        "-h" | "--help" => Some(HELP.to_owned()),
        "-V" | "--version" => Some(format!("gleaner-supervisor {}", gleaner_base::version())),
        _ => None,
    }
}

fn listener() -> Result<UnixListener, Failure> {
    let unusable = |error: &dyn std::error::Error| {
        Failure::caused_by(Exit::Usage, "standard input is not a listening socket", error)
            .with_help("`gleaner-orchestrator` starts this program")
    };
    let stdin: OwnedFd = rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3)
        .map_err(|error| unusable(&std::io::Error::from(error)))?;
    let listens = rustix::net::sockopt::socket_acceptconn(&stdin);
    match listens.map_err(|error| unusable(&std::io::Error::from(error)))? {
        true => Ok(UnixListener::from(stdin)),
        false => Err(unusable(&std::io::Error::other("it does not listen"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_and_the_help_need_no_socket() {
        let version = answer("--version").unwrap();
        assert_eq!(version, format!("gleaner-supervisor {}", gleaner_base::version()));
        assert!(answer("--help").unwrap().contains("gleaner-orchestrator"));
        assert_eq!(answer("--other"), None);
    }
}
