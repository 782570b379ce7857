//! The program `gleaner-recorder`: one process records live topics for all lambdas.
//!
//! - `args`: the command line.
//! - `connections`: a thread for the starter, and one for each lambda, which receive their
//!   messages.
//! - `topics`, `samples`: the recorded topics, which the ingress shares: descriptions, and samples
//!   in the order of their stamps.
//! - `background`: a thread that searches definitions, and checks the disk.
//! - `roster`, `lambdas`: the announced and connected lambdas, and their rate limits.
//! - `commands`: recordings requested over a topic.
//! - `event_loop`: owns the recorder, and never blocks on a disk, a lambda or the network.
//! - `status`, `report_writer`: reports to the starter, and the thread that writes them, as the
//!   starter may be slow to read.
//!
//! Nothing here runs code of a lambda, accepts one lambda in the place of another, or lets a sample
//! wait for a file.

mod args;
mod background;
mod commands;
mod connections;
mod event_loop;
mod lambdas;
mod report_writer;
mod roster;
mod samples;
mod status;
#[cfg(test)]
mod tests;
mod topics;

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use gleaner_base::{Exit, Failure, safe_file};
use gleaner_messages::Sources;
use gleaner_messages::transport::Clock;
use gleaner_protocol::Handover;
use gleaner_protocol::link::LinkError;
use gleaner_protocol::process_stats::log;
use gleaner_protocol::process_stats::start::{reports, stop_flag};
use gleaner_sandbox::recorder as sandbox;
use gleaner_trust::{ClipSigner, SecretKey, VehicleName};
use rustix::process::{Signal, set_parent_process_death_signal};

use crate::RecordError;
use args::Args;
pub use event_loop::run;

#[derive(Clone, Debug)]
pub struct RecorderOptions {
    /// The folder of clips and their list.
    pub out: PathBuf,
    pub clock: Clock,
    /// Places of message definitions, which are searched before those that the source carries.
    pub messages: Sources,
    /// Bytes of the preroll; `None`: the sum of what the lambdas request.
    pub preroll_bytes: Option<u64>,
    /// Bytes of the disk to keep free.
    pub disk_floor: u64,
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep, in bytes.
    pub bytes_max: Option<u64>,
    /// The topic of commands, for messages to users; `None`: commands are off.
    pub commands: Option<String>,
}

#[derive(Debug)]
pub struct RecorderConnections {
    /// Requests of the starter.
    pub control: OwnedFd,
    pub ingress: OwnedFd,
    /// The socket over which the starter passes connections to later ingresses; without one, the
    /// recorder ends with the ingress.
    pub starter: Option<OwnedFd>,
    /// The key with which clips are signed, and the name of the vehicle; `None`: they are not.
    pub signer: Option<ClipSigner>,
}

pub fn main() -> ExitCode {
    log::init_service();
    match start(Args::parse()) {
        Ok(()) => Exit::Ok.into(),
        Err(failure) => {
            log::failure(&failure);
            failure.exit.into()
        }
    }
}

fn start(args: Args) -> Result<(), Failure> {
    let internal = |what: &'static str| {
        move |error: io::Error| Failure::caused_by(Exit::Internal, what, &error)
    };
    // First: threads that exist already would keep their privileges. The folder must exist.
    safe_file::folder(&args.out)
        .map_err(|source| RecordError::Create { path: args.out.clone(), source })?;
    log::layers(sandbox::enter(std::slice::from_ref(&args.out)));
    // A starter that dies also closes our standard input. In either case, open clips are completed.
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(io::Error::from)
        .map_err(internal("cannot watch for the parent process's death"))?;
    let stop = stop_flag().map_err(internal("cannot handle SIGTERM"))?;
    // Ctrl-C in a terminal reaches all processes; the starter decides when this one ends.
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::default())
        .map_err(internal("cannot handle SIGINT"))?;
    let unusable = |error: LinkError| {
        Failure::caused_by(Exit::Usage, "cannot use the connections of the parent process", &error)
            .with_help("start it with `gleaner run LAMBDA`")
    };
    let mut handover = Handover::receive(rustix::stdio::stdin()).map_err(unusable)?;
    let starter = rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3)
        .map_err(io::Error::from)
        .map_err(internal("cannot take the socket of the parent process"))?;
    let control = handover.take_control().map_err(unusable)?;
    let ingress = handover.take_ingress().map_err(unusable)?;
    let signer = signer(args.vehicle_name.clone(), handover.key.take())?;
    let reports = reports().map_err(internal("cannot set up the report stream"))?;
    let connections = RecorderConnections { control, ingress, starter: Some(starter), signer };
    run(args.read(), connections, reports, stop)
}

/// Returns the signer of clips, with the key in a file that the starter has opened.
fn signer(
    vehicle: Option<VehicleName>,
    key: Option<OwnedFd>,
) -> Result<Option<ClipSigner>, Failure> {
    match (vehicle, key) {
        (None, None) => Ok(None),
        (Some(vehicle), Some(key)) => {
            let key = SecretKey::read(&File::from(key)).map_err(|error| {
                Failure::caused_by(Exit::Usage, "cannot use the key for clips", &error)
            })?;
            Ok(Some(ClipSigner::new(key, vehicle)))
        }
        _ => {
            let message = "to sign clips, the recorder needs a key and the name of the vehicle";
            Err(Failure::new(Exit::Usage, message)
                .with_help("start it with `gleaner run LAMBDA --sign KEY`"))
        }
    }
}
