//! The event loop, which owns the recorder. It works in small steps, so that a trigger is handled
//! within a fraction of a millisecond.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, Builder};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Store;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::RecorderReport;
use gleaner_transport::{Clock, LiveSource};
use gleaner_vitals::IntervalDurations;
use tracing::{error, warn};

use super::RecorderOptions;
use super::commands::Commands;
use super::connections::{LoopEvent, starter};
use super::lambdas::ConnectedLambda;
use super::report_writer::ReportWriter;
use super::staging::{Block, Staging, TopicSink};
use super::status::LastReported;
use super::topic_watch::{RequestKind, SystemHealth, TopicRequest, TopicWatch, WatchEvent};
use crate::recorder::counted;
use crate::{Recorder, RecordingFolder, Settings, TopicId, Work};

/// Maximum number of events that are queued for the loop.
const EVENTS: usize = 256;
/// Maximum numbers of samples and bytes that are taken before the loop checks for triggers again.
const SAMPLES_TURN: usize = 64;
const BYTES_TURN: usize = 256 << 10;
/// Longest wait before samples are checked, if nothing else happens.
const IDLE_WAIT: Duration = Duration::from_millis(5);
/// Longest wait while the thread that writes clips is behind.
const WRITER_WAIT: Duration = Duration::from_millis(1);
/// A sample is stamped before it is staged: the recorder's time advances only when all samples up
/// to then must have arrived.
const MARGIN_NS: i64 = 100_000_000;
/// Time that the last messages of lambdas may take, and the last sample.
const FINISH_TIMEOUT: Duration = Duration::from_secs(1);
const FINISH_POLL: Duration = Duration::from_millis(2);
/// Room for staged samples: twice this is allocated.
pub(super) const STAGING: std::ops::RangeInclusive<usize> = 8 << 20..=256 << 20;
/// Free space above the floor from which on clips are begun again.
const SLACK: u64 = 64 << 20;

/// Records until the starter sends stop, or ends, or `stop` is set; then open clips are completed.
///
/// # Errors
///
/// [`Failure`] if the folder cannot be used, if the preroll fails, or if the network is dead: the
/// starter then restarts the process.
pub fn run(
    options: RecorderOptions,
    source: impl FnOnce() -> Result<Box<dyn LiveSource>, Failure>,
    control: OwnedFd,
    reports: File,
    stop: Arc<AtomicBool>,
) -> Result<(), Failure> {
    let internal =
        |error: std::io::Error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
    let mut folder = RecordingFolder::open_without_recovery(&options.out)?;
    let mut reports = ReportWriter::start(reports, folder.losses()).map_err(internal)?;
    // Before recovery, which takes disk space.
    let mut deleted = Vec::new();
    if options.clips_max.is_some() || options.bytes_max.is_some() {
        deleted = folder.keep_at_most(options.clips_max, options.bytes_max)?;
    }
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
    let (events, inbox) = sync_channel(EVENTS);
    let (requests, requested) = sync_channel(EVENTS);
    let reader = thread::current();
    let watch = TopicWatch {
        source: source()?,
        requests: requested,
        events: events.clone(),
        reader: reader.clone(),
        out: options.out.clone(),
    };
    let watch =
        Builder::new().name("watch".to_owned()).spawn(move || watch.run()).map_err(internal)?;
    starter(control, events, reader.clone()).map_err(internal)?;
    let commands = options.commands.clone().map(|name| {
        let (commands, sink) = Commands::new(name.clone(), reader.clone());
        let _ = requests.send(TopicRequest {
            what: RequestKind::Commands,
            name,
            type_name: None,
            sink,
        });
        commands
    });
    reports.send(RecorderReport::Ready);
    let (gone, stuck) = counted(&deleted);
    let mut recorder_loop = RecorderLoop {
        recorder,
        clock: options.clock,
        staging: Staging::new(*STAGING.start(), reader),
        block: Block::new(*STAGING.start()),
        at: 0,
        room: *STAGING.start(),
        inbox,
        requests,
        commands,
        lambdas: Vec::new(),
        topics: BTreeMap::new(),
        shares: BTreeMap::new(),
        reported: LastReported::default(),
        health: SystemHealth::default(),
        spreads: IntervalDurations::new(),
        counted: RecordingCounts {
            deleted: gone,
            not_deleted: stuck,
            ..RecordingCounts::default()
        },
        is_ending: false,
        options,
        stop,
        reports,
    };
    deleted.into_iter().for_each(|loss| recorder_loop.reports.send(RecorderReport::Loss(loss)));
    let ended = recorder_loop.run();
    let last = recorder_loop.final_status();
    // A watch thread that waits for room in the inbox would never end.
    drop((recorder_loop.requests, recorder_loop.inbox));
    recorder_loop.reports.end(RecorderReport::Ended(Box::new(last)));
    // The watch thread ends by itself, and with it the network.
    let _ = watch.join();
    ended
}

/// The result of a turn for samples.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum SampleTurn {
    /// There may be more samples.
    More,
    /// There are no samples.
    Nothing,
    /// A sample is being copied: it is unknown what came before it is accepted.
    Copying,
}

/// A topic that is recorded.
pub(super) struct TopicEntry {
    pub(super) name: String,
    pub(super) type_name: Option<String>,
    pub(super) sink: Arc<TopicSink>,
}

pub(super) struct RecorderLoop {
    pub(super) recorder: Recorder,
    pub(super) clock: Clock,
    pub(super) staging: Arc<Staging>,
    /// The samples that are being taken, and the index of the next one.
    block: Block,
    at: usize,
    /// Room that a block of staged samples has to have.
    pub(super) room: usize,
    inbox: Receiver<LoopEvent>,
    pub(super) requests: SyncSender<TopicRequest>,
    pub(super) commands: Option<Commands>,
    pub(super) lambdas: Vec<ConnectedLambda>,
    pub(super) topics: BTreeMap<TopicId, TopicEntry>,
    /// For each lambda: the requested store and bytes of the preroll, and the expected bytes per
    /// second.
    pub(super) shares: BTreeMap<String, (Store, u64, usize)>,
    pub(super) reported: LastReported,
    pub(super) health: SystemHealth,
    pub(super) spreads: IntervalDurations,
    /// The counts of the loop: lambdas and wakes that were refused, and clips that were deleted
    /// before anything was recorded. The recorder counts the rest.
    pub(super) counted: RecordingCounts,
    is_ending: bool,
    pub(super) options: RecorderOptions,
    stop: Arc<AtomicBool>,
    pub(super) reports: ReportWriter,
}

impl RecorderLoop {
    fn run(&mut self) -> Result<(), Failure> {
        loop {
            let mut is_busy = self.events()?;
            is_busy |= self.poll_lambdas()?;
            if let Some(commands) = &mut self.commands {
                is_busy |= commands.handle(&mut self.recorder)?;
            }
            is_busy |= self.samples(SAMPLES_TURN)? == SampleTurn::More;
            let work = self.recorder.work()?;
            self.report(false)?;
            if let Some(why) = self.health.source.dead.take() {
                self.finish()?;
                return Err(Failure {
                    causes: vec![why],
                    ..Failure::new(Exit::Internal, "the network is dead")
                });
            }
            if self.is_ending || self.stop.load(Ordering::Relaxed) {
                return self.finish();
            }
            if !is_busy && work != Work::More {
                thread::park_timeout(if work == Work::Wait { WRITER_WAIT } else { IDLE_WAIT });
            }
        }
    }

    /// Handles the events of the starter and of the watch thread.
    fn events(&mut self) -> Result<bool, Failure> {
        let mut is_busy = false;
        while let Ok(event) = self.inbox.try_recv() {
            is_busy = true;
            match event {
                LoopEvent::Registered(registration) => self.register(*registration)?,
                LoopEvent::Refused => self.counted.lambdas_refused += 1,
                LoopEvent::Stop => self.is_ending = true,
                LoopEvent::Watch(WatchEvent::Found { topic, schema }) => {
                    let type_name = schema.type_name.clone();
                    match (
                        self.recorder.found_topic(topic, schema, self.clock.now()),
                        self.topics.get_mut(&topic),
                    ) {
                        (Ok(()), Some(recorded)) => recorded.type_name = Some(type_name),
                        (Ok(()), None) => {}
                        (Err(error), _) => {
                            error!(
                                error = &error as &dyn std::error::Error,
                                "cannot record a topic"
                            );
                        }
                    }
                }
                LoopEvent::Watch(WatchEvent::Health(health)) => {
                    self.health = *health;
                    self.check_disk()?;
                }
            }
        }
        Ok(is_busy)
    }

    /// Suspends recording while the free disk space is below the floor.
    fn check_disk(&mut self) -> Result<(), Failure> {
        let (Some(free), floor) = (self.health.disk_free, self.options.disk_floor) else {
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

    fn poll_lambdas(&mut self) -> Result<bool, Failure> {
        let mut is_busy = false;
        let mut index = 0;
        while index < self.lambdas.len() {
            let (now, clock) = (self.clock.now(), self.clock);
            let monotonic = || clock.monotonic(clock.now());
            let polled =
                self.lambdas[index].poll(&mut self.recorder, now, monotonic, &mut self.spreads)?;
            is_busy |= polled.is_busy;
            self.counted.lambdas_refused += u64::from(polled.is_refused);
            self.counted.add(&polled.counted);
            if let (Some(commands), Some(id)) = (&mut self.commands, polled.is_new) {
                commands.add(&self.lambdas[index].name, id);
            }
            if polled.is_gone {
                self.lambdas.swap_remove(index);
            } else {
                index += 1;
            }
        }
        Ok(is_busy)
    }

    /// Takes some of the staged samples.
    fn samples(&mut self, max_samples: usize) -> Result<SampleTurn, Failure> {
        let (mut samples, mut bytes) = (0, 0);
        while let Some((staged, cdr)) = self.block.get(self.at) {
            if samples == max_samples || bytes >= BYTES_TURN {
                return Ok(SampleTurn::More);
            }
            match staged.bytes {
                Some(_) => self.recorder.sample(staged.topic, &staged.meta, cdr)?,
                None => self.recorder.lost_sample(staged.topic, &staged.meta),
            }
            (self.at, samples, bytes) = (self.at + 1, samples + 1, bytes + cdr.len());
        }
        let now = self.clock.now();
        let mut empty = std::mem::take(&mut self.block);
        if empty.room() < self.room {
            empty = Block::new(self.room);
        }
        empty.clear();
        self.at = 0;
        match self.staging.exchange(empty) {
            Ok(block) => self.block = block,
            Err(empty) => {
                // Time advances only once all earlier samples are known.
                self.block = empty;
                return Ok(SampleTurn::Copying);
            }
        }
        if self.block.get(0).is_none() {
            self.recorder.advance(now.saturating_sub(MARGIN_NS))?;
            return Ok(SampleTurn::Nothing);
        }
        // A topic is announced before its first sample.
        self.events()?;
        Ok(SampleTurn::More)
    }

    /// Takes the remaining samples and wakes, and completes open clips.
    fn finish(&mut self) -> Result<(), Failure> {
        // The processes of lambdas have ended, or will: their last messages are still in transit.
        let until = Instant::now() + FINISH_TIMEOUT;
        while !self.lambdas.is_empty() && Instant::now() < until {
            if !self.poll_lambdas()? {
                thread::park_timeout(FINISH_POLL);
            }
        }
        let end = self.clock.now();
        let until = Instant::now() + FINISH_TIMEOUT;
        // Three blocks at most: samples in a later one are later than the end.
        let mut blocks = 0;
        while blocks < 4 {
            match self.samples(usize::MAX)? {
                SampleTurn::More => blocks += u32::from(self.at == 0),
                // No sample takes that long to copy.
                SampleTurn::Copying if Instant::now() < until => thread::park_timeout(FINISH_POLL),
                SampleTurn::Copying | SampleTurn::Nothing => break,
            }
        }
        self.recorder.finish(end)?;
        self.report(true)
    }
}
