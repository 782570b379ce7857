//! The program `gleaner-recorder`: one process records for all lambdas, from live topics.
//!
//! - `args`: the command line.
//! - `hear`: a thread for the starter, and one for each lambda: what they say, on its way to the
//!   loop.
//! - `staging`: samples on their way from the transport's thread to the loop; all memory of it is
//!   there before they come.
//! - `watch`: a thread that finds topics, subscribes them, and looks after the network and the
//!   disk.
//! - `announce`: a lambda will come: what it records is wanted, and room for it made.
//! - `lambdas`: who is heard, and how much each may ask for: `allowance`.
//! - `commands`: what somebody outside may ask for, over a topic.
//! - `course`: the loop: it owns the recorder, and nothing in it waits for a disk, a lambda or the
//!   network.
//! - `telling`, `say`: what the starter is told, and a thread that writes reports, for a starter
//!   that may be slow to read them.
//!
//! What never happens here: a lambda's code; a lambda that speaks for another; a sample that is
//! kept waiting for a file.

mod args;
mod commands;
mod connections;
mod event_loop;
mod lambdas;
mod rate_limit;
mod register;
mod report_writer;
mod staging;
mod status;
mod topic_watch;

use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_transport::Clock;
use gleaner_vitals::start::{reports, stop_flag};
use rustix::process::{Signal, set_parent_process_death_signal};

use args::Args;
pub use event_loop::run;

/// How the process records.
#[derive(Clone, Debug)]
pub struct RecorderOptions {
    /// The folder of clips and their list.
    pub out: PathBuf,
    /// The clock of samples and wakes.
    pub clock: Clock,
    /// Bytes of the preroll; `None`: as many as the lambdas ask for together.
    pub preroll_bytes: Option<u64>,
    /// Bytes of the disk that stay free.
    pub disk_floor: u64,
    /// Most clips that are kept.
    pub clips_max: Option<u64>,
    /// Most bytes of clips that are kept.
    pub bytes_max: Option<u64>,
    /// The topic of commands; `None`: none are heard.
    pub commands: Option<String>,
}

/// `main` of `gleaner-recorder`.
pub fn main() -> ExitCode {
    gleaner_vitals::log::init();
    match start(Args::parse()) {
        Ok(()) => Exit::Ok.into(),
        Err(failure) => {
            eprintln!("{failure}");
            failure.exit.into()
        }
    }
}

fn start(args: Args) -> Result<(), Failure> {
    let internal = |what: &'static str| {
        move |error: io::Error| Failure::caused_by(Exit::Internal, what, &error)
    };
    // A starter that dies closes our standard input as well. Whatever comes first, open clips are
    // completed.
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(io::Error::from)
        .map_err(internal("cannot be told of the starter's death"))?;
    let stop = stop_flag().map_err(internal("cannot handle SIGTERM"))?;
    // Ctrl-C in a terminal reaches all processes; the starter says when this one ends.
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::default())
        .map_err(internal("cannot handle SIGINT"))?;
    let control = control()?;
    let reports = reports().map_err(internal("cannot set up the report stream"))?;
    let (options, network) = args.read()?;
    run(options, || network.open(), control, reports, stop)
}

/// Standard input, which has to be the socket of the starter.
fn control() -> Result<OwnedFd, Failure> {
    let stdin = rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3);
    let is_socket = |fd: &OwnedFd| rustix::net::sockopt::socket_type(fd).is_ok();
    stdin.ok().filter(is_socket).ok_or_else(|| {
        Failure::new(Exit::Usage, "standard input is not the socket of a starter")
            .with_help("start it with `gleaner run LAMBDA`")
    })
}
