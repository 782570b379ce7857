//! Sets up the process of a live run: arguments, connections, signals.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::Clock;
use gleaner_protocol::Handover;
use gleaner_protocol::process_stats::start::stop_flag;
use gleaner_samples::Feed;
use gleaner_sandbox::Paths;

use super::{LiveRun, ResultsPipe, Settings};
use crate::isolation::{Isolation, definition_dirs};
use crate::session_setup::{ConfiguredLambda, LambdaArgs, Load, take_stdin};

/// Upper bound of the decisions that wait to be written, in bytes.
pub(crate) const UNWRITTEN: u64 = 48 << 20;

/// Arguments of `run`. Standard input is a socket of the starter, which passes the connections to
/// the ingress and, if there is one, the recorder.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    #[command(flatten)]
    pub lambda_args: LambdaArgs,
    /// Folder of the results, for reports: the process that created their pipe writes there.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Offset of the vehicle's clock from CLOCK_MONOTONIC, in ns.
    #[arg(long, value_name = "NS", allow_hyphen_values = true)]
    pub clock_offset: Option<i64>,
    /// Answer each wake on this topic, as sensor_msgs/msg/TimeReference.
    #[arg(long, value_name = "TOPIC")]
    pub rtt: Option<String>,
    /// Publish decisions with a trigger or a fault on this topic, as std_msgs/msg/String.
    #[arg(long, value_name = "TOPIC")]
    pub decisions: Option<String>,
    /// Number of earlier starts of this lambda's process.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub restarts: u32,
}

pub struct LiveJob {
    pub lambda: ConfiguredLambda,
    pub manifest: Manifest,
    settings: Settings,
}

impl LiveJob {
    /// Paths that may be opened while the lambda runs.
    pub fn paths(&self) -> Paths {
        let mut read = definition_dirs();
        read.push(self.lambda.folder.clone());
        read.extend(self.lambda.vehicle.clone());
        Paths { read, write: Vec::new() }
    }

    /// Memory that Gleaner's own threads may still allocate, in bytes.
    pub fn own_memory(&self) -> u64 {
        UNWRITTEN
    }

    /// Checks the arguments against the build and its manifest.
    pub fn new(args: RunArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.lambda_args.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let lambda = ConfiguredLambda::new(args.lambda_args, build, &mut manifest)?;
        let settings = Settings {
            out: args.out,
            all: args.all,
            restarts: args.restarts,
            clock: args.clock_offset.map_or_else(Clock::from_time_of_day, Clock::new),
            round_trip: args.rtt,
            announce: args.decisions,
        };
        Ok(Self { lambda, manifest, settings })
    }

    /// Connects to the ingress and runs the lambda until SIGTERM, with reports to `reports`.
    ///
    /// # Errors
    ///
    /// As [`LiveRun::run`], and a failure if there is no starter or no ingress.
    pub fn run(
        self,
        load: Load<'_>,
        isolation: &Isolation,
        reports: impl Write + Send + 'static,
    ) -> Result<Exit, Failure> {
        let Self { mut lambda, manifest, settings } = self;
        let stop = stop_flag().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot listen for SIGTERM", &error)
        })?;
        // Open until the run is over: the starter sees its end, and may pass further connections.
        let starter = take_stdin()?;
        let unconnected = |error| Failure::because("cannot receive the connections", &error);
        let mut connections = Handover::receive(&starter).map_err(unconnected)?;
        let ingress = connections.take_ingress().map_err(unconnected)?;
        let feed = Feed::connect(ingress)
            .map_err(|error| Failure::because("cannot connect to the ingress", &error))?;
        lambda.use_models(&manifest, connections.inference.take())?;
        let heartbeat = isolation.heartbeat().clone();
        let run = LiveRun {
            lambda,
            manifest,
            settings,
            feed,
            starter: Some(starter),
            recorder: connections.recorder.take(),
            results: ResultsPipe::open(heartbeat.clone())?,
            heartbeat,
            close: &mut || isolation.close().map(<[_]>::to_vec),
            stop: &stop,
        };
        run.run(load, reports)
    }
}
