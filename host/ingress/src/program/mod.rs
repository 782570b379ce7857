//! The program `gleaner-ingress`: one process receives the samples of all lambdas.
//!
//! - `args`: the command line.
//! - `source`: the network or a drive.
//! - `real_time`: priority over other programs, if it is permitted.
//! - `network`: failures of the network, for users.
//! - `topics`: lists the topics of the network, for `gleaner topics`.

mod args;
mod network;
mod real_time;
mod source;
mod topics;

use std::io;
use std::process::ExitCode;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::IngressServer;
use gleaner_protocol::process_stats::start::{reports, stop_socket};
use gleaner_protocol::process_stats::{ReportWriter, log};
use gleaner_samples::regions::TopicRegion;
use gleaner_sandbox::ingress as sandbox;
use rustix::process::{Signal, set_parent_process_death_signal};
use tracing::warn;

use crate::Ingress;
use args::{Args, IngressCommand};
use topics::TopicsArgs;

/// Permissions, one of which real-time priority needs.
const REAL_TIME_HELP: &str = "it needs `ulimit -r 1` or CAP_SYS_NICE; in a service, \
                              `LimitRTPRIO=1` and `RestrictRealtime=no`";

pub fn main() -> ExitCode {
    log::init_service();
    let mut args = Args::parse();
    let ended = match args.command.take() {
        Some(IngressCommand::Topics(topics)) => list_topics(topics),
        Some(IngressCommand::RealTime) => real_time::enter().map_err(|error| {
            let what = "the system refuses real-time priority";
            Failure::caused_by(Exit::Internal, what, &error).with_help(REAL_TIME_HELP)
        }),
        None => start(args),
    };
    match ended {
        Ok(()) => Exit::Ok.into(),
        Err(failure) => {
            log::failure(&failure);
            failure.exit.into()
        }
    }
}

fn list_topics(args: TopicsArgs) -> Result<(), Failure> {
    let mut reports = reports().map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot set up the report stream", &error)
    })?;
    topics::run(args, &mut reports)
}

fn start(args: Args) -> Result<(), Failure> {
    let internal = |what: &'static str| {
        move |error: io::Error| Failure::caused_by(Exit::Internal, what, &error)
    };
    // Before there are other threads, and before it is denied.
    let real_time = args.real_time && enter_real_time();
    // Threads that exist already would keep their privileges.
    let layers = sandbox::start(&args.paths(), real_time);
    // A starter that dies also closes the control connection.
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(io::Error::from)
        .map_err(internal("cannot watch for the parent process's death by `prctl`"))?;
    let stop = stop_socket().map_err(internal("cannot handle SIGTERM"))?;
    let control = control()?;
    let reports = reports().map_err(internal("cannot set up the report stream"))?;
    // Not without seals: a reader could change what others read.
    TopicRegion::create("gleaner-test", 1, 1)
        .map_err(internal("cannot share samples by `memfd_create`"))?;
    let new_sockets = args.new_sockets();
    let source = source::open(args, real_time)?;
    let layers = sandbox::close(layers, new_sockets).map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot close the sandbox of the ingress", &error)
    })?;
    log::layers(layers);
    let writer = ReportWriter::start(reports).map_err(internal("cannot start a thread"))?;
    let sender = writer.sender();
    let ingress = Ingress::new(source, Box::new(move |report| sender.send(report)));
    let ended = ingress.run(control, Some(stop));
    writer.end();
    ended.map_err(internal("cannot wait for readers"))
}

/// Enters real time; returns whether this succeeded. A vehicle that may not goes on without it.
fn enter_real_time() -> bool {
    let entered = real_time::enter();
    if let Err(error) = &entered {
        warn!(%error, help = REAL_TIME_HELP, "the system refuses real-time priority");
    }
    entered.is_ok()
}

/// Receives the control connection over standard input, the socket of the starter.
fn control() -> Result<IngressServer, Failure> {
    let failed = |error: gleaner_protocol::link::LinkError| {
        Failure::from(error).with_help("start it with `gleaner run LAMBDA`")
    };
    let mut handover = Handover::receive(rustix::stdio::stdin()).map_err(failed)?;
    handover.take_control().map(IngressServer::new).map_err(failed)
}
