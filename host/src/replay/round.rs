//! One pass of a lambda over its drives.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Explain, Failure};
use gleaner_drives::{Progress, Replay, Step};
use gleaner_journal::{End, Part};
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::{Report, Round, Summary, TopicReport, WokenBy};
use gleaner_vitals::usage;

use super::course::{self, Course, Reached, Span};
use super::digests::Digests;
use super::journal_file::JournalFile;
use super::open::{DriveError, open_drives};
use super::options::Results;
use super::record::{ReplayRecorder, remove_clips};
use super::signals::Gathered;
use super::{CLOCK, Options, report as send};
use crate::api::Session;
use crate::api::data::{Counts, Topic, Wake};
use crate::api::log::Line;
use crate::api::trace::offered;
use crate::guest::Totals;
use crate::journal::{Identity, Scribe};
use crate::judge::Judge;
use crate::schedule::Schedule;
use crate::stage::{Asked, Bounds, Load, Output, OutputError, Stage, not_started};

/// How often progress is reported; a person sees no more.
const PROGRESS: Duration = Duration::from_millis(100);
/// The clock is read once in so many samples.
const SAMPLES_PER_LOOK: u64 = 256;

struct Pass<'a> {
    judge: Judge,
    schedule: Schedule,
    session: Session,
    output: &'a mut Output,
    reports: &'a mut dyn Write,
    /// Fills in what the journal and the clips say of a wake; none where there is neither.
    scribe: Option<Scribe>,
    journal: Option<JournalFile>,
    recording: Option<ReplayRecorder>,
    gathered: Gathered,
    part: Part,
    wakes: u64,
    triggers: u64,
    faults: u64,
    /// Why the lambda's process could not go on.
    stopped: Option<String>,
    log_lines: u64,
    samples: u64,
    looked: Instant,
}

impl Course for Pass<'_> {
    fn schedule(&mut self) -> &mut Schedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        if self.judge.is_backing_off(&wake) {
            return Ok(true);
        }
        if let Some(scribe) = &mut self.scribe {
            scribe.begin(&wake);
        }
        let decision = self.judge.judge(wake);
        self.wakes += 1;
        self.triggers += decision.triggers.len() as u64;
        self.faults += u64::from(decision.fault.is_some());
        self.output.decision(&decision)?;
        self.gathered.wake(&decision);
        let (log, said) = self.session.take_log();
        self.keep(&log)?;
        if let Some(scribe) = &mut self.scribe {
            let entry = scribe.end(&decision, said);
            if let Some(journal) = &mut self.journal {
                journal.wake(entry)?;
            }
            // A clip is listed after the decisions that it is about, wherever a kill meets this
            // process.
            if !entry.triggers.is_empty() {
                self.output.flush()?;
            }
            if let Some(recording) = &self.recording {
                recording.wake(entry)?;
            }
        }
        // In a replay a killed process is not started again: what it kept is gone, and what would
        // follow is no replay of the vehicle.
        self.stopped = decision
            .fault
            .filter(|fault| fault.kind == FaultKind::Killed)
            .map(|fault| fault.message);
        Ok(self.stopped.is_none())
    }

    fn sample(&mut self, drive: &Replay, step: &Step) -> Result<(), Failure> {
        if let Some(recording) = &self.recording {
            recording.check()?;
        }
        self.samples += 1;
        if self.samples.is_multiple_of(SAMPLES_PER_LOOK) && self.looked.elapsed() >= PROGRESS {
            self.looked = Instant::now();
            self.output.flush()?;
            let progress = drive.progress();
            let report =
                Report::Progress { done: progress.done, total: progress.total, at_ns: step.at_ns };
            send(self.reports, &report);
        }
        Ok(())
    }
}

impl Pass<'_> {
    fn keep(&mut self, log: &[Line]) -> Result<(), Failure> {
        self.log_lines += log.len() as u64;
        Ok(self.output.log(log)?)
    }

    /// Writes what waits.
    fn flush(&mut self) -> Result<(), Failure> {
        self.output.flush()?;
        Ok(self.journal.as_mut().map_or(Ok(()), JournalFile::flush)?)
    }

    /// Ends the lambda's process after its last wake, where it has one of its own.
    fn finish(&mut self, at_ns: i64, manifest: &Manifest) -> Result<Option<Totals>, Failure> {
        match self.judge.finish() {
            Ok(totals) => Ok(totals),
            Err(fault) => {
                self.faults += 1;
                self.stopped = Some(fault.message.clone());
                self.output.decision(&WokenBy::schedule_of(manifest).faulted(at_ns, 0, fault))?;
                Ok(None)
            }
        }
    }

    /// Goes through the drive, and closes what is recorded.
    fn run(
        &mut self,
        drive: &mut Replay,
    ) -> Result<(Reached, gleaner_protocol::Recording), Failure> {
        let span = Span::of(drive, self.part);
        let reached = course::take(drive, span, self)?;
        // Of a damaged drive nobody knows what came after the last sample.
        let is_whole = reached.broken.is_none() && !reached.stopped;
        let end_ns = span.end_ns.filter(|_| is_whole).unwrap_or(reached.at_ns);
        let recorded = self
            .recording
            .as_ref()
            .map_or(Ok(Default::default()), |recording| recording.finish(end_ns))?;
        Ok((reached, recorded))
    }
}

/// How a pass ended.
pub(super) struct Ended {
    pub(super) summary: Summary,
    /// Why the drive could not be read to its end.
    pub(super) broken: Option<Exit>,
    /// Why signals or pictures are missing.
    pub(super) incomplete: Option<OutputError>,
}

pub(super) fn replay(
    options: &Options,
    results: &Results,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &mut dyn Write,
    is_first: bool,
) -> Result<Ended, Failure> {
    let name = manifest.lambda.name.as_str();
    let (mut drive, part) = open_drives(options)?;
    let mut recording = if results.record {
        ReplayRecorder::subscribe(manifest, options, &mut drive)?
    } else {
        None
    };
    let Stage { inputs, session, mut guest } =
        Stage::set(&mut drive, &options.asked, manifest, Bounds::Replay, None, load)?;
    let started = Instant::now();
    let mut header = None;
    if results.journal.is_some() || recording.is_some() {
        let Asked { build, config, remaps, .. } = &options.asked;
        header = Some(
            Identity {
                manifest,
                build,
                config,
                remaps,
                engine: guest.engine(),
                clock: CLOCK,
                part,
            }
            .header()?,
        );
    }
    // The memory of its preroll is none of the lambda's, which is bounded from `init` on.
    if let (Some(recording), Some(header)) = (&mut recording, &header) {
        recording.start(&results.out, header)?;
    }
    let digests = results.journal.as_ref().map(|_| Digests::start(options.drives.files.clone()));
    let gathered = Gathered::of(&inputs, recording.as_ref().and_then(ReplayRecorder::camera));
    let layers = guest.layers()?;
    if is_first {
        send(reports, &Report::Isolation { layers });
    }
    let initialised = guest.init();
    // What `init` says is no part of a wake.
    let (said, _) = session.take_log();
    initialised.map_err(|fault| not_started(name, fault, &said))?;
    // Only now does it cost the results of an earlier replay: what could not start must not touch
    // them.
    let journal = results.journal.as_deref().zip(header.as_ref());
    let journal = journal.map(|(path, header)| JournalFile::create(path, header)).transpose()?;
    let mut output = Output::create(&results.out, results.all)?;
    let clips_replaced = match &mut recording {
        Some(recording) => recording.replace()?,
        None => remove_clips(&results.out)?,
    };
    let mut pass = Pass {
        schedule: Schedule::new(manifest, &inputs),
        judge: Judge::new(session.clone(), guest),
        session,
        output: &mut output,
        reports,
        scribe: header.is_some().then(|| Scribe::new(&inputs)),
        journal,
        recording,
        gathered,
        part,
        wakes: 0,
        triggers: 0,
        faults: 0,
        stopped: None,
        log_lines: 0,
        samples: 0,
        looked: Instant::now(),
    };
    pass.keep(&said)?;

    let ran = pass.run(&mut drive);
    // Whatever ended it, what was decided until then is kept.
    let flushed = pass.flush();
    let (reached, recorded) = ran?;
    flushed?;
    let broken = reached.broken.map(DriveError);
    let totals = if pass.stopped.is_none() { pass.finish(reached.at_ns, manifest)? } else { None };
    if let (Some(journal), Some(digests)) = (pass.journal.take(), digests) {
        let samples = inputs.iter().map(|topic| offered(topic)).collect();
        // A journal of a damaged drive, or of a lambda that was killed, has no end: it cannot say
        // what comes there.
        let end = End { wakes: pass.wakes, samples, drives: digests.take()? };
        journal.finish((broken.is_none() && pass.stopped.is_none()).then_some(&end))?;
    }
    let totals = totals.unwrap_or_else(|| Totals::of(&inputs, pass.gathered.curves()));
    let wall_s = started.elapsed().as_secs_f64();
    let summary = Summary {
        lambda: name.to_owned(),
        version: manifest.lambda.version.to_string(),
        kind: manifest.lambda.kind,
        drive: options.drives.named.iter().map(|drive| shown(drive)).collect(),
        out: shown(&results.out),
        wakes: pass.wakes,
        triggers: pass.triggers,
        faults: pass.faults,
        skipped: totals
            .counts
            .iter()
            .fold(0, |sum: u64, counts| sum.saturating_add(counts.skipped)),
        missed_ticks: pass.schedule.missed(),
        out_of_order: drive.out_of_order(),
        log_lines: pass.log_lines,
        log_dropped: pass.session.log_dropped(),
        triggers_refused: pass.session.triggers_refused(),
        backed_off: pass.session.backed_off(),
        start_ns: drive.start_ns().unwrap_or(0),
        end_ns: drive.end_ns().unwrap_or(reached.at_ns.max(drive.start_ns().unwrap_or(0))),
        part,
        wall_s,
        run_s: pass.judge.run().as_secs_f64(),
        decode_s: totals.decode_ns as f64 / 1e9,
        wakes_per_s: if wall_s > 0.0 { pass.wakes as f64 / wall_s } else { 0.0 },
        peak_rss_bytes: pass.judge.most_resident_bytes(),
        topics: inputs.iter().zip(&totals.counts).map(topic_report).collect(),
        recording: recorded,
        clips_replaced,
        damaged: broken.as_ref().map(|error| {
            let mut failure = Failure::because("the drive could not be read to its end", error);
            failure.causes.push(read_so_far(&drive, reached.at_ns));
            failure.to_string()
        }),
        stopped: pass.stopped.clone(),
    };
    // A report is drawn from these. The other results are whole without them.
    let incomplete =
        pass.gathered.write(&results.out, pass.output, &options.asked.config, totals).err();
    output.finish(&summary)?;
    Ok(Ended { summary, broken: broken.map(|error| error.exit()), incomplete })
}

/// What was read of a drive that is damaged: what is lost is the rest.
fn read_so_far(drive: &Replay, at_ns: i64) -> String {
    let Progress { done, total } = drive.progress();
    let seconds = at_ns.saturating_sub(drive.start_ns().unwrap_or(0)) as f64 / 1e9;
    match total.filter(|total| *total > done) {
        Some(total) if done > 0 => {
            format!("read: {done} of {total} messages, up to {seconds:.3} s")
        }
        // Without an index, nobody knows how many there were.
        None if done > 0 => {
            format!("read: {done} messages, up to {seconds:.3} s; what came later is lost")
        }
        _ => "read: no message of these topics".to_owned(),
    }
}

pub(super) fn report(n: u32, summary: &Summary) -> Round {
    Round {
        n,
        wakes: summary.wakes,
        faults: summary.faults,
        wall_s: summary.wall_s,
        wakes_per_s: summary.wakes_per_s,
        rss_bytes: usage::resident(),
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

/// A path as JSON can hold it: what is no UTF-8 is replaced.
fn shown(path: &Path) -> PathBuf {
    PathBuf::from(path.to_string_lossy().into_owned())
}
