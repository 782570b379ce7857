//! A lambda live: on the topics of a vehicle, in its time, with a deadline, until it is told to stop.
//!
//! One thread owns the lambda and waits here; the transport's thread fills the rings and rings a bell. Files of results are written by
//! another process, and reports to the starter by a thread of their own. Nothing here knows which kind of lambda runs.

mod announce;
mod course;
mod ledger;
mod options;
mod pages;
mod recorder;
mod round_trip;
mod speaker;
mod status;

pub use options::{Job, RunArgs};

use std::io::Write;

use gleaner_protocol::journal::Part;
use gleaner_protocol::manifest::Schedule as Declared;
use gleaner_protocol::{Exit, Failure, Page, Report, WokenBy};
use gleaner_transport::dds::Dds;

use self::announce::Announcer;
use self::course::Course;
use self::ledger::Ledger;
use self::options::take_stdin;
use self::pages::Pages;
use self::recorder::ToRecorder;
use self::round_trip::RoundTrip;
use self::status::{Around, Watch};
use crate::input::{Bell, Live};
use crate::isolation::Isolation;
use crate::journal::{CLOCK_OF_VEHICLE, Identity};
use crate::judge::Judge;
use crate::network::NetworkError;
use crate::schedule::Schedule;
use crate::stage::{Bounds, Load, Stage, not_started};

impl Job {
    /// Runs the lambda until SIGTERM, and writes reports to `reports`.
    ///
    /// The exit is [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
    ///
    /// # Errors
    ///
    /// A failure if it cannot start, if the network or the recorder fails, or if results could not be handed on.
    pub fn run(
        self,
        load: Load<'_>,
        isolation: &Isolation,
        reports: impl Write + Send + 'static,
    ) -> Result<Exit, Failure> {
        let Self { asked, manifest, wanted } = self;
        let stop = gleaner_vitals::start::stop_flag()
            .map_err(|error| Failure::caused_by(Exit::Internal, "cannot listen for SIGTERM", &error))?;
        let clock = wanted.dds.clock;
        let domain = wanted.dds.domain;
        let mut dds = Dds::open(wanted.dds).map_err(NetworkError::failure)?;
        let bell = match &manifest.schedule {
            Declared::Event { input, .. } => Some(Bell { input: input.to_string(), thread: std::thread::current() }),
            Declared::Periodic { .. } => None,
        };
        let bounds = Bounds::Live(manifest.limits.deadline);
        let Stage { inputs, session, mut guest } =
            Stage::set(&mut dds, &asked, &manifest, bounds, Some(&Live { bell }), load)?;
        let recorder = match wanted.recorder.then(take_stdin).transpose()? {
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
        let round_trip = wanted.round_trip.map(|topic| RoundTrip::open(&dds, &topic, clock, name)).transpose()?;
        let announcer = wanted.announce.map(|topic| Announcer::open(&dds, &topic, name)).transpose()?;
        let pages = Pages::open(isolation.pulse().clone())?;
        let mut ledger = Ledger::start(pages, wanted.all, reports)?;
        ledger.page(&Page::Woken(WokenBy::schedule_of(&manifest)));
        ledger.report(Report::Isolation { layers: isolation.close()?.to_vec() });
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
        let watch = Watch::new(&manifest, &asked.remaps, wanted.out, wanted.restarts, domain, clock);
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
            dds,
            clock,
            pulse: isolation.pulse().clone(),
        };
        let ended = course.run(&stop);
        let faults = course.watch.faults();
        course.schedule.finish();
        let unsent = course.unsent();
        let Course { ledger, watch, inputs, schedule, session, recorder, dds, .. } = course;
        let dropped = recorder.map(ToRecorder::leave);
        let last = watch.ended(&Around {
            dds: &dds,
            health: &dds.health(),
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
