//! Runs a lambda on live topics: in real time, with deadlines, until SIGTERM.
//!
//! One thread owns the lambda and waits here, for the bell that the ingress rings; samples are read
//! in the ingress's memory. Another process writes the result files, and a separate thread the
//! reports to the parent. Nothing here depends on the kind of the lambda, or knows a network.

mod announce;
mod event_loop;
mod process;
mod recorder;
mod results_pipe;
mod results_writer;
mod round_trip;
mod status;
mod topic_publisher;

pub(crate) use process::UNWRITTEN;
pub use process::{LiveJob, RunArgs};
pub use results_pipe::ResultsPipe;

use std::io::Write;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use gleaner_base::{Exit, Failure};
use gleaner_journal::TimeRange;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::Clock;
use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::{Layer, Report, ResultItem, WokenBy};
use gleaner_samples::{Feed, ReconnectingReader};

use self::announce::Announcer;
use self::event_loop::LiveEventLoop;
use self::recorder::RecorderSender;
use self::results_writer::ResultsWriter;
use self::round_trip::RoundTrip;
use self::status::{StatusContext, StatusReporter};
use self::topic_publisher::TopicPublisher;
use crate::invoker::Invoker;
use crate::schedule::WakeSchedule;
use crate::session_setup::{ConfiguredLambda, Load, RunMode, SessionSetup, not_started};

/// A live run, without the set-up of its process.
pub struct LiveRun<'a> {
    pub lambda: ConfiguredLambda,
    /// Its manifest, with the limits that hold.
    pub manifest: Manifest,
    pub settings: Settings,
    /// The connection to the ingress. It grants the inputs of the manifest, with their indexes as
    /// ids, and then the topics of [`Settings::round_trip`] and [`Settings::announce`], as far as
    /// they are set, to publish.
    pub feed: Feed,
    /// The socket over which the starter passes connections to later ingresses and recorders;
    /// without one, the run ends with them.
    pub starter: Option<OwnedFd>,
    /// The socket to the recorder, if there is one.
    pub recorder: Option<OwnedFd>,
    pub results: ResultsPipe,
    /// The page that shows the shim how long this thread may be busy.
    pub heartbeat: Heartbeat,
    /// Drops the privileges that the process no longer needs, before the lambda is entered; returns
    /// the layers of the sandbox.
    pub close: &'a mut dyn FnMut() -> Result<Vec<Layer>, Failure>,
    pub stop: &'a AtomicBool,
}

#[derive(Clone, Debug)]
pub struct Settings {
    /// Folder of the results, for reports.
    pub out: PathBuf,
    /// Set if decisions without trigger and fault are results, too.
    pub all: bool,
    /// Number of earlier starts of this lambda's process.
    pub restarts: u32,
    pub clock: Clock,
    /// The topic on which each wake is answered, if any.
    pub round_trip: Option<String>,
    /// The topic on which decisions are published, if any.
    pub announce: Option<String>,
}

impl LiveRun<'_> {
    /// Runs the lambda until it is stopped, and writes reports to `reports`.
    ///
    /// The exit is [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
    ///
    /// # Errors
    ///
    /// A failure if it cannot start, if the ingress or the recorder fails, or if results could not
    /// be sent.
    pub fn run(
        self,
        load: Load<'_>,
        reports: impl Write + Send + 'static,
    ) -> Result<Exit, Failure> {
        let Self { lambda, manifest, settings, mut feed, starter, recorder, .. } = self;
        let Self { results, heartbeat, close, stop, .. } = self;
        let clock = settings.clock;
        let mode = RunMode::Live(manifest.limits.deadline);
        let SessionSetup { inputs, session, mut guest } =
            SessionSetup::load_fed(&mut feed, &lambda, &manifest, mode, load)?;
        let recorder = recorder.map(|socket| {
            let (engine, part) = (guest.engine().to_string(), TimeRange::default());
            let header = lambda.header(&manifest, &engine, &clock.to_string(), part)?;
            RecorderSender::join(socket, header, &inputs, starter.is_some())
        });
        let recorder = recorder.transpose()?;
        let name = manifest.lambda.name.as_str();
        // In the order of the grants.
        let mut publishers = (0..).map(|index| feed.publisher(index));
        let mut publisher =
            |topic: String| publishers.next().map(|it| TopicPublisher::new(topic, it));
        let round_trip = settings.round_trip.and_then(&mut publisher);
        let round_trip = round_trip.map(|publisher| RoundTrip::new(publisher, clock, name));
        let announcer = settings.announce.and_then(&mut publisher);
        let announcer = announcer.map(|publisher| Announcer::new(publisher, name));
        let mut results = ResultsWriter::start(results, settings.all, reports)?;
        results.page(&ResultItem::Woken(WokenBy::schedule_of(&manifest)));
        results.report(Report::Isolation { layers: close()? });
        let initialised = guest.init();
        let (init_log, _) = session.take_log();
        results.log(init_log);
        if let Err(fault) = initialised {
            // Its log may explain the fault.
            results.finish(None)?;
            return Err(not_started(name, fault, &[]));
        }
        results.report(Report::Ready);
        let schedule = WakeSchedule::live(&manifest, &inputs, clock.now());
        let watch =
            StatusReporter::new(&manifest, &lambda.remaps, settings.out, settings.restarts, clock);
        let mut event_loop = LiveEventLoop {
            invoker: Invoker::new(session.clone(), guest),
            schedule,
            session,
            inputs,
            results,
            recorder,
            round_trip,
            announcer,
            watch,
            bell: feed.bell(),
            connections: 0,
            feed: ReconnectingReader::new(feed, starter),
            clock,
            heartbeat,
        };
        let ended = event_loop.run(stop);
        let faults = event_loop.watch.faults();
        finish(event_loop)?;
        ended?;
        Ok(if faults > 0 { Exit::LambdaFaulted } else { Exit::Ok })
    }
}

/// Leaves the recorder, and sends the last results and the summary.
fn finish(mut event_loop: LiveEventLoop) -> Result<(), Failure> {
    event_loop.schedule.finish();
    let unsent = event_loop.unsent();
    event_loop.note_engine();
    let LiveEventLoop { results, watch, inputs, schedule, session, recorder, feed, .. } =
        event_loop;
    let dropped = recorder.map(RecorderSender::leave);
    let last = watch.ended(&StatusContext {
        feed: &feed,
        inputs: &inputs,
        schedule: &schedule,
        session: &session,
        unwritten: results.unwritten(),
        unsent,
        recorder_link: dropped,
    });
    results.finish(Some(last))
}
