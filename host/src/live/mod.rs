//! A lambda live: on the topics of a vehicle, in its time, with a deadline, until it is told to
//! stop.
//!
//! One thread owns the lambda and waits here; the transport's thread fills the rings and rings a
//! bell. Files of results are written by another process, and reports to the starter by a thread of
//! their own. Nothing here knows which kind of lambda runs, nor which network its samples come
//! over; `process` does, and has the process to itself.

mod announce;
mod course;
mod ledger;
mod pages;
#[cfg(feature = "dds")]
mod process;
mod recorder;
mod round_trip;
mod speaker;
mod status;

pub use pages::Pages;
#[cfg(feature = "dds")]
pub use process::{Job, RunArgs};

use std::io::Write;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use gleaner_base::{Exit, Failure};
use gleaner_journal::Part;
use gleaner_lambda::manifest::{Manifest, Schedule as Declared};
use gleaner_protocol::{Layer, Page, Report, WokenBy};
use gleaner_transport::{Clock, LiveSource};
use gleaner_vitals::Pulse;

use self::announce::Announcer;
use self::course::Course;
use self::ledger::Ledger;
use self::recorder::ToRecorder;
use self::round_trip::RoundTrip;
use self::status::{Around, Watch};
use crate::input::{Bell, Live};
use crate::journal::{CLOCK_OF_VEHICLE, Identity};
use crate::judge::Judge;
use crate::schedule::Schedule;
use crate::stage::{Asked, Bounds, Load, Stage, not_started};

/// A live run, apart from the process that has nothing else to do.
pub struct Run<'a> {
    /// The lambda.
    pub asked: Asked,
    /// Its manifest, with the limits that hold.
    pub manifest: Manifest,
    /// How it runs.
    pub settings: Settings,
    /// Where samples come from.
    pub source: Box<dyn LiveSource>,
    /// The socket to the recorder, where there is one.
    pub recorder: Option<OwnedFd>,
    /// Where results go.
    pub results: Pages,
    /// The page that shows how long this thread may be away.
    pub pulse: Pulse,
    /// Gives up what the process does not need any more, before the lambda is entered; returns what
    /// holds.
    pub close: &'a mut dyn FnMut() -> Result<Vec<Layer>, Failure>,
    /// Raised when the run is to end.
    pub stop: &'a AtomicBool,
}

/// How a lambda runs live.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where the results go, for reports.
    pub out: PathBuf,
    /// Whether decisions without trigger and fault are results, too.
    pub all: bool,
    /// How often this lambda's process was started before.
    pub restarts: u32,
    /// The vehicle's clock.
    pub clock: Clock,
    /// The topic on which each wake is answered, if any.
    pub round_trip: Option<String>,
    /// The topic on which decisions are published, if any.
    pub announce: Option<String>,
}

impl Run<'_> {
    /// Runs the lambda until it is stopped, and writes reports to `reports`.
    ///
    /// The exit is [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
    ///
    /// # Errors
    ///
    /// A failure if it cannot start, if the network or the recorder fails, or if results could not
    /// be handed on.
    pub fn run(
        self,
        load: Load<'_>,
        reports: impl Write + Send + 'static,
    ) -> Result<Exit, Failure> {
        let Self { asked, manifest, settings, mut source, recorder, results, pulse, close, stop } =
            self;
        let clock = settings.clock;
        let bell = match &manifest.schedule {
            Declared::Event { input, .. } => {
                Some(Bell { input: input.to_string(), thread: std::thread::current() })
            }
            Declared::Periodic { .. } => None,
        };
        let bounds = Bounds::Live(manifest.limits.deadline);
        let Stage { inputs, session, mut guest } =
            Stage::set(&mut *source, &asked, &manifest, bounds, Some(&Live { bell }), load)?;
        let recorder = match recorder {
            Some(socket) => {
                let (build, config, remaps) = (&asked.build, &asked.config, &asked.remaps);
                let engine = guest.engine();
                let identity = Identity {
                    manifest: &manifest,
                    build,
                    config,
                    remaps,
                    engine,
                    clock: CLOCK_OF_VEHICLE,
                    part: Part::default(),
                };
                Some(ToRecorder::join(socket, &identity.header()?, &inputs)?)
            }
            None => None,
        };
        let name = manifest.lambda.name.as_str();
        let round_trip = settings
            .round_trip
            .map(|topic| RoundTrip::open(&*source, &topic, clock, name))
            .transpose()?;
        let announcer =
            settings.announce.map(|topic| Announcer::open(&*source, &topic, name)).transpose()?;
        let mut ledger = Ledger::start(results, settings.all, reports)?;
        ledger.page(&Page::Woken(WokenBy::schedule_of(&manifest)));
        ledger.report(Report::Isolation { layers: close()? });
        let initialised = guest.init();
        let (said, _) = session.take_log();
        ledger.log(said);
        if let Err(fault) = initialised {
            // What it said on the way may be why.
            ledger.finish(None)?;
            return Err(not_started(name, fault, &[]));
        }
        ledger.report(Report::Ready);
        let schedule = Schedule::live(&manifest, &inputs, clock.now());
        let watch = Watch::new(&manifest, &asked.remaps, settings.out, settings.restarts, clock);
        let mut course = Course {
            judge: Judge::new(session.clone(), guest),
            schedule,
            session,
            inputs,
            ledger,
            recorder,
            round_trip,
            announcer,
            watch,
            source,
            clock,
            pulse,
        };
        let ended = course.run(stop);
        let faults = course.watch.faults();
        course.schedule.finish();
        let unsent = course.unsent();
        let Course { ledger, watch, inputs, schedule, session, recorder, source, .. } = course;
        let dropped = recorder.map(ToRecorder::leave);
        let last = watch.ended(&Around {
            source: &*source,
            health: &source.health(),
            inputs: &inputs,
            schedule: &schedule,
            session: &session,
            unwritten: ledger.unwritten(),
            unsent,
            recorder: dropped,
        });
        ledger.finish(Some(last))?;
        ended?;
        Ok(if faults > 0 { Exit::LambdaFaulted } else { Exit::Ok })
    }
}
