//! Runs one replay of a lambda over its drives, and writes its results.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Explain, Failure};
use gleaner_drives::{Progress, Replay, ReplayError, ReplayStep};
use gleaner_journal::{JournalEnd, TimeRange};
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::{RecordingCounts, ReplaySummary, Report, TopicReport, WokenBy};

use super::digests::Digests;
use super::drive_loop::{self, DriveHandler, DriveSpan, LoopEnd};
use super::journal_file::JournalFile;
use super::open::{self, DriveError};
use super::options::ReplayOptions;
use super::record::{ReplayRecorder, remove_clips};
use super::reports::send;
use super::signals::SignalCollector;
use crate::api::Session;
use crate::api::data::{Counts, Topic, Wake};
use crate::api::log::LogLine;
use crate::api::trace::offered;
use crate::guest::{LambdaEngine, Totals};
use crate::invoker::Invoker;
use crate::journal::{CLOCK_OF_DRIVE, EntryBuilder};
use crate::schedule::WakeSchedule;
use crate::session_setup::{Load, Output, OutputError, RunMode, SessionSetup, not_started};

/// Interval of progress reports; a shorter one is not visible to a user.
const PROGRESS: Duration = Duration::from_millis(100);
const SAMPLES_PER_CLOCK_READ: u64 = 256;

pub(super) struct Results {
    pub(super) out: PathBuf,
    /// Set if every decision is written.
    pub(super) all: bool,
    /// Set if clips are written.
    pub(super) record: bool,
    pub(super) journal: Option<PathBuf>,
    pub(super) repeat: u32,
}

struct ReplayLoop<'a> {
    invoker: Invoker,
    schedule: WakeSchedule,
    session: Session,
    output: Output,
    reports: &'a mut dyn Write,
    /// Builds the entries of the journal and the clips; `None` if there is neither.
    entry_builder: Option<EntryBuilder>,
    journal: Option<JournalFile>,
    /// Checksums of the drives, for the end of the journal.
    digests: Option<Digests>,
    recording: Option<ReplayRecorder>,
    signals: SignalCollector,
    engine: LambdaEngine,
    part: TimeRange,
    /// Number of clips of an earlier replay that were removed.
    clips_replaced: u64,
    wakes: u64,
    triggers: u64,
    faults: u64,
    /// The fault with which the lambda's process ended early.
    stopped: Option<String>,
    log_lines: u64,
    samples: u64,
    progress_sent: Instant,
}

impl DriveHandler for ReplayLoop<'_> {
    fn schedule(&mut self) -> &mut WakeSchedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        if self.invoker.is_backing_off(&wake) {
            return Ok(true);
        }
        if let Some(entry_builder) = &mut self.entry_builder {
            entry_builder.begin(&wake);
        }
        let decision = self.invoker.invoke(wake);
        self.wakes += 1;
        self.triggers += decision.triggers.len() as u64;
        self.faults += u64::from(decision.fault.is_some());
        self.output.decision(&decision)?;
        self.signals.wake(&decision);
        let (log, digest) = self.session.take_log();
        self.write_log(&log)?;
        if let Some(entry_builder) = &mut self.entry_builder {
            let entry = entry_builder.end(&decision, digest);
            if let Some(journal) = &mut self.journal {
                journal.wake(entry)?;
            }
            // A clip is listed after its decisions, even if this process is killed in between.
            if !entry.triggers.is_empty() {
                self.output.flush()?;
            }
            if let Some(recording) = &self.recording {
                recording.wake(entry)?;
            }
        }
        // A replay does not restart a killed process: its state is lost, and the rest would not be
        // a replay of the vehicle.
        self.stopped = decision
            .fault
            .filter(|fault| fault.kind == FaultKind::Killed)
            .map(|fault| fault.message);
        Ok(self.stopped.is_none())
    }

    fn sample(&mut self, drive: &Replay, step: &ReplayStep) -> Result<(), Failure> {
        if let Some(recording) = &self.recording {
            recording.check()?;
        }
        self.samples += 1;
        if self.samples.is_multiple_of(SAMPLES_PER_CLOCK_READ)
            && self.progress_sent.elapsed() >= PROGRESS
        {
            self.progress_sent = Instant::now();
            self.output.flush()?;
            let progress = drive.progress();
            let report =
                Report::Progress { done: progress.done, total: progress.total, at_ns: step.at_ns };
            send(self.reports, &report);
        }
        Ok(())
    }
}

impl ReplayLoop<'_> {
    fn write_log(&mut self, log: &[LogLine]) -> Result<(), Failure> {
        self.log_lines += log.len() as u64;
        Ok(self.output.log(log)?)
    }

    fn flush(&mut self) -> Result<(), Failure> {
        self.output.flush()?;
        Ok(self.journal.as_mut().map_or(Ok(()), JournalFile::flush)?)
    }

    /// Ends the lambda's own process after its last wake, if it has one that has not ended early.
    fn finish(&mut self, at_ns: i64, manifest: &Manifest) -> Result<Option<Totals>, Failure> {
        if self.stopped.is_some() {
            return Ok(None);
        }
        match self.invoker.finish() {
            Ok(totals) => Ok(totals),
            Err(fault) => {
                self.faults += 1;
                self.stopped = Some(fault.message.clone());
                self.output.decision(&WokenBy::schedule_of(manifest).faulted(at_ns, 0, fault))?;
                Ok(None)
            }
        }
    }

    /// Runs the lambda over the drive, and closes open clips.
    fn run(&mut self, drive: &mut Replay) -> Result<(LoopEnd, RecordingCounts), Failure> {
        let span = DriveSpan::of(drive, self.part);
        let reached = drive_loop::run(drive, span, self)?;
        // The end of a damaged drive is unknown: its last sample counts.
        let is_whole = reached.broken.is_none() && !reached.stopped;
        let end_ns = span.end_ns.filter(|_| is_whole).unwrap_or(reached.at_ns);
        let recorded = self
            .recording
            .as_ref()
            .map_or(Ok(Default::default()), |recording| recording.finish(end_ns))?;
        Ok((reached, recorded))
    }

    /// Ends the journal, if there is one, with the checksums of the drives.
    fn finish_journal(&mut self, is_whole: bool) -> Result<(), Failure> {
        let ended = self.journal.take().zip(self.digests.take());
        let Some((journal, digests)) = ended else { return Ok(()) };
        let samples = self.session.inputs().iter().map(|topic| offered(topic)).collect();
        let end = JournalEnd { wakes: self.wakes, samples, drives: digests.take()? };
        // A journal of a damaged drive, or of a lambda that was killed, gets no end, which would
        // claim to be complete.
        Ok(journal.finish((is_whole && self.stopped.is_none()).then_some(&end))?)
    }

    /// Runs the lambda over the drive, and writes the results into `out`.
    fn complete(
        mut self,
        mut drive: Replay,
        options: &ReplayOptions,
        out: &Path,
        manifest: &Manifest,
    ) -> Result<ReplayOutcome, Failure> {
        let started = Instant::now();
        let ran = self.run(&mut drive);
        // Decisions up to an error are kept.
        let flushed = self.flush();
        let (reached, recorded) = ran?;
        flushed?;
        let broken = reached.broken.map(DriveError);
        let totals = self.finish(reached.at_ns, manifest)?;
        self.finish_journal(broken.is_none())?;
        let inputs = self.session.inputs();
        let totals = totals.unwrap_or_else(|| Totals::of(&inputs, self.signals.curves()));
        let end = ReplayEnd {
            drive: &drive,
            at_ns: reached.at_ns,
            broken: broken.as_ref(),
            recorded,
            totals: &totals,
            wall_s: started.elapsed().as_secs_f64(),
        };
        let summary = self.summary(options, out, manifest, end);
        let Self { signals, output, .. } = self;
        // Only the HTML report needs these. The other results are complete without them.
        let incomplete = signals.write(out, &output, &options.lambda.config, totals).err();
        output.finish(&summary)?;
        Ok(ReplayOutcome { summary, broken: broken.map(|error| error.exit()), incomplete })
    }

    fn summary(
        &self,
        options: &ReplayOptions,
        out: &Path,
        manifest: &Manifest,
        end: ReplayEnd<'_>,
    ) -> ReplaySummary {
        let ReplayEnd { drive, at_ns, broken, recorded, totals, wall_s } = end;
        let start_ns = drive.start_ns().unwrap_or(0);
        ReplaySummary {
            lambda: manifest.lambda.name.to_string(),
            version: manifest.lambda.version.to_string(),
            kind: manifest.lambda.kind,
            drive: options.drives.named.iter().map(|drive| lossy_path(drive)).collect(),
            out: lossy_path(out),
            wakes: self.wakes,
            triggers: self.triggers,
            faults: self.faults,
            skipped: totals
                .counts
                .iter()
                .fold(0, |sum: u64, counts| sum.saturating_add(counts.skipped)),
            missed_ticks: self.schedule.missed(),
            out_of_order: drive.out_of_order(),
            malformed: drive.malformed().clone(),
            log_lines: self.log_lines,
            log_dropped: self.session.log_dropped(),
            triggers_refused: self.session.triggers_refused(),
            backed_off: self.session.backed_off(),
            start_ns,
            end_ns: drive.end_ns().unwrap_or(at_ns.max(start_ns)),
            part: self.part,
            wall_s,
            run_s: self.invoker.run().as_secs_f64(),
            decode_s: totals.decode_ns as f64 / 1e9,
            wakes_per_s: if wall_s > 0.0 { self.wakes as f64 / wall_s } else { 0.0 },
            peak_rss_bytes: self.invoker.peak_resident_bytes(),
            topics: self.session.inputs().iter().zip(&totals.counts).map(topic_report).collect(),
            recording: recorded,
            models: self.engine.models.clone(),
            clips_replaced: self.clips_replaced,
            damaged: broken.map(|error| {
                let mut failure = Failure::because("the drive could not be read in full", error);
                if !matches!(error.0, ReplayError::WithoutLatched { .. }) {
                    failure.causes.push(read_so_far(drive, at_ns));
                }
                failure.to_string()
            }),
            stopped: self.stopped.clone(),
        }
    }
}

/// The end of a replay, for its summary.
struct ReplayEnd<'a> {
    drive: &'a Replay,
    /// Stamp of the last sample; 0 if there was none.
    at_ns: i64,
    broken: Option<&'a DriveError>,
    recorded: RecordingCounts,
    totals: &'a Totals,
    wall_s: f64,
}

pub(super) struct ReplayOutcome {
    pub(super) summary: ReplaySummary,
    /// Exit of a drive that could not be read in full.
    pub(super) broken: Option<Exit>,
    /// The error that prevented signals or pictures.
    pub(super) incomplete: Option<OutputError>,
}

pub(super) fn replay(
    mut drive: Replay,
    options: &ReplayOptions,
    results: &Results,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &mut dyn Write,
    is_first: bool,
) -> Result<ReplayOutcome, Failure> {
    let part = open::restrict(&mut drive, options)?;
    let mut recording = match results.record {
        true => ReplayRecorder::subscribe(manifest, options, &mut drive)?,
        false => None,
    };
    let SessionSetup { inputs, session, mut guest } =
        SessionSetup::load(&mut drive, &options.lambda, manifest, RunMode::Replay, load)?;
    let engine = guest.engine();
    let header = (results.journal.is_some() || recording.is_some())
        .then(|| options.lambda.header(manifest, &engine.to_string(), CLOCK_OF_DRIVE, part));
    let header = header.transpose()?;
    // Its preroll is allocated before `init`, from which on memory counts as the lambda's.
    if let (Some(recording), Some(header)) = (&mut recording, &header) {
        recording.start(&results.out, header)?;
    }
    // Before `init`, too.
    drive.start().map_err(DriveError)?;
    let digests = results.journal.as_ref().map(|_| Digests::start(options.drives.files.clone()));
    let signals = SignalCollector::of(&inputs, recording.as_ref().and_then(ReplayRecorder::camera));
    let layers = guest.layers()?;
    if is_first {
        send(reports, &Report::Isolation { layers });
    }
    let initialised = guest.init();
    // The log of `init` belongs to no wake.
    let (init_log, _) = session.take_log();
    initialised.map_err(|fault| not_started(manifest.lambda.name.as_str(), fault, &init_log))?;
    // The results of an earlier replay are removed only now: a failed start must not touch them.
    let journal = results.journal.as_deref().zip(header.as_ref());
    let journal = journal.map(|(path, header)| JournalFile::create(path, header)).transpose()?;
    let output = Output::create(&results.out, results.all)?;
    let clips_replaced = match &mut recording {
        Some(recording) => recording.replace()?,
        None => remove_clips(&results.out)?,
    };
    let mut replay_loop = ReplayLoop {
        schedule: WakeSchedule::new(manifest, &inputs),
        invoker: Invoker::new(session.clone(), guest),
        session,
        output,
        reports,
        entry_builder: header.is_some().then(|| EntryBuilder::new(&inputs)),
        journal,
        digests,
        recording,
        signals,
        engine,
        part,
        clips_replaced,
        wakes: 0,
        triggers: 0,
        faults: 0,
        stopped: None,
        log_lines: 0,
        samples: 0,
        progress_sent: Instant::now(),
    };
    replay_loop.write_log(&init_log)?;
    replay_loop.complete(drive, options, &results.out, manifest)
}

/// Describes the part of a damaged drive that was read.
fn read_so_far(drive: &Replay, at_ns: i64) -> String {
    let Progress { done, total } = drive.progress();
    let seconds = at_ns.saturating_sub(drive.start_ns().unwrap_or(0)) as f64 / 1e9;
    match total.filter(|total| *total > done) {
        Some(total) if done > 0 => {
            format!("read: {done} of {total} messages, up to {seconds:.3} s")
        }
        // Without an index, the total is unknown.
        None if done > 0 => {
            format!("read: {done} messages, up to {seconds:.3} s; later messages are lost")
        }
        _ => "read: no message of the inputs".to_owned(),
    }
}

fn topic_report((topic, counts): (&Arc<Topic>, &Counts)) -> TopicReport {
    TopicReport {
        name: topic.name().to_owned(),
        topic: topic.ros_topic().to_owned(),
        type_name: topic.type_name().to_owned(),
        received: counts.received,
        lost: counts.lost,
        overwritten: counts.overwritten,
        no_slot: counts.no_slot,
        too_big: counts.too_big,
    }
}

/// A path as JSON can hold it: invalid UTF-8 is replaced.
fn lossy_path(path: &Path) -> PathBuf {
    PathBuf::from(path.to_string_lossy().into_owned())
}
