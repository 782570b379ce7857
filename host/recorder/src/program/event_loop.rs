//! The event loop, which owns the recorder. It works in small steps, so that a trigger is handled
//! within a fraction of a millisecond.

use std::fs::File;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Store;
use gleaner_messages::transport::Clock;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::ingress::COMMANDS_ID;
use gleaner_protocol::link::{RecorderReport, RecorderStatus};
use gleaner_samples::{Feed, ReconnectingReader, Waker};
use tracing::warn;

use super::background::{Background, SystemHealth};
use super::commands::Commands;
use super::connections::{LoopEvent, starter};
use super::report_writer::ReportWriter;
use super::roster::Roster;
use super::status::Reporter;
use super::topics::Topics;
use super::{RecorderConnections, RecorderOptions};
use crate::recorder::counted;
use crate::{RecordError, Recorder, RecorderCounts, RecordingFolder, Settings, Work};

/// Maximum number of events that are queued for the loop.
const EVENTS: usize = 256;
/// Maximum number of samples that are taken before the loop checks for triggers again.
const SAMPLES_TURN: usize = 64;
/// Longest wait before samples are looked for, if nothing rings: samples do not ring, as a trigger
/// is urgent and a sample is not.
const IDLE_WAIT: Duration = Duration::from_millis(5);
/// Longest wait while the thread that writes clips is behind.
const WRITER_WAIT: Duration = Duration::from_millis(1);
/// A sample is stamped before the ingress shows it: the recorder's time advances only when all
/// samples up to then must have arrived.
const MARGIN_NS: i64 = 100_000_000;
/// Time that the last messages of lambdas may take.
const FINISH_TIMEOUT: Duration = Duration::from_secs(1);
const FINISH_POLL: Duration = Duration::from_millis(2);
/// Free space above the floor from which on clips are begun again.
const SLACK: u64 = 64 << 20;

/// Records until the starter sends stop, or ends, or `stop` is set; then open clips are completed.
///
/// While there is no ingress, windows and clips go on without samples; after its restart, the
/// starter passes a connection to it.
///
/// # Errors
///
/// [`Failure`] if the folder cannot be used, if the preroll fails, or if the ingress ends and is
/// not restarted: the starter then restarts the process.
pub fn run(
    options: RecorderOptions,
    connections: RecorderConnections,
    reports: File,
    stop: Arc<AtomicBool>,
) -> Result<(), Failure> {
    let (mut recorder_loop, background) = start(options, connections, reports, stop)?;
    let ended = recorder_loop.run();
    let counts = recorder_loop.recorder.counts();
    let last = RecorderStatus {
        trigger_to_open: recorder_loop.roster.spreads().all(),
        ..recorder_loop.status(&counts)
    };
    // A thread that waits for room in the inbox would never end.
    drop((recorder_loop.topics, recorder_loop.inbox));
    recorder_loop.reporter.end(RecorderReport::Ended(Box::new(last)));
    let _ = background.join();
    ended
}

fn live_recorder(
    folder: RecordingFolder,
    options: &RecorderOptions,
) -> Result<Recorder, RecordError> {
    let settings = Settings {
        store: Store::Ram,
        preroll_bytes: options.preroll_bytes.unwrap_or(1 << 20),
        max_length: Duration::from_secs(1),
        folder: options.out.clone(),
        clock: options.clock.to_string(),
        prefault: true,
    };
    let mut recorder = Recorder::live(folder, settings)?;
    recorder.advance(options.clock.now())?;
    Ok(recorder)
}

/// Starts the threads of the process; returns the loop, and the background thread.
fn start(
    options: RecorderOptions,
    connections: RecorderConnections,
    reports: File,
    stop: Arc<AtomicBool>,
) -> Result<(RecorderLoop, JoinHandle<()>), Failure> {
    let internal =
        |error: std::io::Error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
    let RecorderConnections { control, ingress, starter: starter_socket, signer } = connections;
    let mut folder = RecordingFolder::open_without_recovery(&options.out)?;
    if let Some(signer) = signer {
        folder.sign_clips(signer);
    }
    let mut reports = ReportWriter::start(reports, folder.losses()).map_err(internal)?;
    // Before recovery, which takes disk space.
    let mut deleted = Vec::new();
    if options.clips_max.is_some() || options.bytes_max.is_some() {
        deleted = folder.keep_at_most(options.clips_max, options.bytes_max)?;
    }
    let recorder = live_recorder(folder, &options)?;
    let feed = Feed::connect(ingress).map_err(|error| {
        Failure::caused_by(Exit::Unreachable, "cannot join the ingress", &error)
    })?;
    // Of the first ingress, for the whole time: the threads of this process ring it, and a later
    // ingress has nothing to ring for that could not wait for `IDLE_WAIT`.
    let bell = feed.bell();
    let feed = ReconnectingReader::new(feed, starter_socket);
    let (events, inbox) = sync_channel(EVENTS);
    let (searches, requests) = channel();
    let background = Background {
        sources: options.messages.clone(),
        requests,
        events: events.clone(),
        bell: bell.clone(),
        out: options.out.clone(),
    };
    let background = background.start().map_err(internal)?;
    starter(control, events, bell.clone()).map_err(internal)?;
    reports.send(RecorderReport::Ready);
    let (gone, stuck) = counted(&deleted);
    let mut recorder_loop = RecorderLoop {
        recorder,
        clock: options.clock,
        bell,
        inbox,
        topics: Topics::new(feed, searches),
        polled_at: None,
        looked_at: options.clock.now(),
        commands: options.commands.map(Commands::new),
        roster: Roster::new(options.preroll_bytes),
        health: SystemHealth::default(),
        deleted: RecordingCounts { deleted: gone, not_deleted: stuck, ..Default::default() },
        disk_floor: options.disk_floor,
        dead: None,
        is_ending: false,
        stop,
        reporter: Reporter::new(reports),
    };
    deleted.into_iter().for_each(|loss| recorder_loop.reporter.send(RecorderReport::Loss(loss)));
    Ok((recorder_loop, background))
}

struct RecorderLoop {
    recorder: Recorder,
    clock: Clock,
    /// Threads of this process ring it after each event.
    bell: Waker,
    inbox: Receiver<LoopEvent>,
    topics: Topics,
    /// The time of the last look at messages of the ingress.
    polled_at: Option<Instant>,
    /// The same, as a stamp.
    looked_at: i64,
    commands: Option<Commands>,
    roster: Roster,
    health: SystemHealth,
    /// Clips that were deleted before anything was recorded. The recorder counts the rest.
    deleted: RecordingCounts,
    disk_floor: u64,
    /// The reason why no further samples come.
    dead: Option<String>,
    is_ending: bool,
    stop: Arc<AtomicBool>,
    reporter: Reporter,
}

impl RecorderLoop {
    fn run(&mut self) -> Result<(), Failure> {
        loop {
            // Before the look at any queue, so that an event after it ends the wait.
            let seen = self.bell.value();
            let mut is_busy = self.events()?;
            is_busy |= self.lambdas()?;
            self.ingress();
            if let Some(commands) = &mut self.commands {
                is_busy |= commands.handle(&mut self.recorder)?;
            }
            is_busy |= self.samples()?;
            let work = self.recorder.work()?;
            self.report(false);
            if let Some(why) = self.dead.take() {
                self.finish()?;
                // The ingress may end first when all is stopped.
                if self.is_stopping()? {
                    return Ok(());
                }
                return Err(Failure {
                    causes: vec![why],
                    ..Failure::new(Exit::Internal, "the recorder receives no samples")
                });
            }
            if self.is_ending || self.stop.load(Ordering::Relaxed) {
                return self.finish();
            }
            if !is_busy && work != Work::More {
                self.bell.wait(seen, if work == Work::Wait { WRITER_WAIT } else { IDLE_WAIT });
            }
        }
    }

    /// Handles the events of the starter and of the background thread.
    fn events(&mut self) -> Result<bool, Failure> {
        let mut is_busy = false;
        while let Ok(event) = self.inbox.try_recv() {
            is_busy = true;
            match event {
                LoopEvent::Registered(registration) => {
                    let (topics, recorder) = (&mut self.topics, &mut self.recorder);
                    self.roster.register(*registration, self.clock.now(), topics, recorder)?;
                }
                LoopEvent::Refused => self.roster.count_refused(),
                LoopEvent::Stop => self.is_ending = true,
                LoopEvent::GiveWay => {
                    self.roster.accept_no_more();
                    self.is_ending = true;
                }
                LoopEvent::Definitions { id, text } => self.topics.found_locally(id, text),
                LoopEvent::Health(health) => {
                    self.health = health;
                    self.check_disk()?;
                }
            }
        }
        Ok(is_busy)
    }

    /// Returns whether the starter stops this process.
    fn is_stopping(&mut self) -> Result<bool, Failure> {
        self.events()?;
        Ok(self.is_ending || self.stop.load(Ordering::Relaxed))
    }

    /// Suspends recording while the free disk space is below the floor.
    fn check_disk(&mut self) -> Result<(), Failure> {
        let (Some(free), floor) = (self.health.disk_free, self.disk_floor) else {
            return Ok(());
        };
        let is_held = self.recorder.is_held();
        if free < floor && !is_held {
            let why = format!("less than {} MiB of disk space were free", floor >> 20);
            warn!(free, floor, "too little free disk space: recording is suspended");
            self.recorder.hold(Some(&why))?;
            if let Some(commands) = &mut self.commands {
                commands.forget_running();
            }
        } else if is_held && free >= floor.saturating_add(SLACK) {
            warn!(free, floor, "enough free disk space again: recording resumes");
            self.recorder.hold(None)?;
        }
        Ok(())
    }

    fn lambdas(&mut self) -> Result<bool, Failure> {
        self.roster.poll(self.clock, &mut self.recorder, self.commands.as_mut())
    }

    /// Handles messages of the ingress, which are few.
    fn ingress(&mut self) {
        if self.polled_at.is_some_and(|at| at.elapsed() < IDLE_WAIT) {
            return;
        }
        self.polled_at = Some(Instant::now());
        let gaps = self.topics.gaps().count;
        let polled = self.topics.poll(self.clock.now());
        let now = self.clock.now();
        let since = std::mem::replace(&mut self.looked_at, now);
        if self.topics.gaps().count > gaps {
            // It ended after the last look; the next one may be joined already.
            self.recorder.note_ingress(since, now, false);
        }
        self.recorder.note_ingress(now, now, self.topics.has_ingress());
        match polled {
            Ok(None) => {}
            Ok(Some(fed)) => {
                if let Some(commands) = &mut self.commands {
                    commands.attach(fed);
                }
            }
            Err(error) => self.dead = Some(gleaner_base::chain(&error)),
        }
    }

    /// Takes some samples; returns whether there may be more.
    fn samples(&mut self) -> Result<bool, Failure> {
        let now = self.clock.now();
        let is_more = self.topics.take(now, SAMPLES_TURN, &mut self.recorder)?;
        if !is_more {
            // Time advances only once all earlier samples are known.
            self.recorder.advance(now.saturating_sub(MARGIN_NS))?;
        }
        Ok(is_more)
    }

    /// Takes the remaining samples and wakes, and completes open clips.
    fn finish(&mut self) -> Result<(), Failure> {
        // The processes of lambdas have ended or will, or can send no more: their last messages are
        // still in transit.
        let until = Instant::now() + FINISH_TIMEOUT;
        while self.roster.len() > 0 && Instant::now() < until {
            let seen = self.bell.value();
            if !self.lambdas()? {
                self.bell.wait(seen, FINISH_POLL);
            }
        }
        let end = self.clock.now();
        self.topics.take(end, usize::MAX, &mut self.recorder)?;
        self.recorder.finish(end)?;
        self.report(true);
        Ok(())
    }

    fn report(&mut self, is_last: bool) {
        let now_ns = self.clock.now();
        if self.reporter.report(&mut self.recorder, now_ns, is_last) {
            let counts = self.recorder.counts();
            let trigger_to_open = self.roster.spreads().take();
            let status = RecorderStatus { trigger_to_open, ..self.status(&counts) };
            self.reporter.send(RecorderReport::Status(Box::new(status)));
        }
    }

    fn status(&self, counts: &RecorderCounts) -> RecorderStatus {
        let mut recording = counts.recording;
        recording.add(&self.deleted);
        recording.add(self.roster.counted());
        let commands = self.commands.as_ref();
        RecorderStatus {
            lambdas: self.roster.len(),
            recording,
            is_recording: self.recorder.is_recording(),
            preroll_bytes: counts.preroll_bytes,
            preroll_bound: counts.preroll_bound,
            in_flight: counts.in_flight,
            trigger_to_open: None,
            commands: commands
                .map(|commands| commands.status(self.topics.reception(COMMANDS_ID).as_ref())),
            topics: self.topics.statuses(),
            network: self.topics.status().health.network.clone(),
            reception_gaps: self.topics.gaps(),
            disk_free: self.health.disk_free,
            rss_bytes: self.health.rss_bytes,
            cpu_s: self.health.cpu_s,
        }
    }
}
