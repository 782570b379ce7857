//! The program `gleaner-recorder`: one process records live topics for all lambdas.
//!
//! - `args`: the command line.
//! - `connections`: a thread for the starter, and one for each lambda, which receive their
//!   messages.
//! - `staging`: samples in transit from the transport's thread to the loop, in memory that is
//!   allocated before.
//! - `topic_watch`: a thread that finds and subscribes topics, and checks the network and the disk.
//! - `register`: requests the topics of an announced lambda, and makes room for it.
//! - `lambdas`: the connected lambdas and their rate limits: `rate_limit`.
//! - `commands`: recordings requested over a topic.
//! - `event_loop`: owns the recorder, and never blocks on a disk, a lambda or the network.
//! - `status`, `report_writer`: reports to the starter, and the thread that writes them, as the
//!   starter may be slow to read.
//!
//! Nothing here runs code of a lambda, accepts one lambda in the place of another, or lets a sample
//! wait for a file.

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

/// Options of the process.
#[derive(Clone, Debug)]
pub struct RecorderOptions {
    /// The folder of clips and their list.
    pub out: PathBuf,
    /// The clock of samples and wakes.
    pub clock: Clock,
    /// Bytes of the preroll; `None`: the sum of what the lambdas request.
    pub preroll_bytes: Option<u64>,
    /// Bytes of the disk to keep free.
    pub disk_floor: u64,
    /// Maximum number of clips to keep.
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep, in bytes.
    pub bytes_max: Option<u64>,
    /// The topic of commands; `None`: commands are off.
    pub commands: Option<String>,
}

/// Runs the program `gleaner-recorder`.
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
    // A starter that dies also closes our standard input. In either case, open clips are completed.
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(io::Error::from)
        .map_err(internal("cannot watch for the starter's death"))?;
    let stop = stop_flag().map_err(internal("cannot handle SIGTERM"))?;
    // Ctrl-C in a terminal reaches all processes; the starter decides when this one ends.
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::default())
        .map_err(internal("cannot handle SIGINT"))?;
    let control = control()?;
    let reports = reports().map_err(internal("cannot set up the report stream"))?;
    let (options, network) = args.read()?;
    run(options, || network.open(), control, reports, stop)
}

/// Returns standard input, which has to be the socket of the starter.
fn control() -> Result<OwnedFd, Failure> {
    let stdin = rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3);
    let is_socket = |fd: &OwnedFd| rustix::net::sockopt::socket_type(fd).is_ok();
    stdin.ok().filter(is_socket).ok_or_else(|| {
        Failure::new(Exit::Usage, "standard input is not the socket of a starter")
            .with_help("start it with `gleaner run LAMBDA`")
    })
}
