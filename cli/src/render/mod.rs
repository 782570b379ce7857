//! Formats results as text for the terminal. It reads and prints nothing.

use std::fmt::{self, Write};
use std::io::{self, IsTerminal};

use gleaner_base::visible;
use gleaner_lambda::{Clip, Decision, Fault, FaultKind, Trigger, TriggerKind};
use gleaner_protocol::{LossOutcome, RecordingCounts, ReplaySummary, TopicReport, Verified};
use gleaner_report::ResultsError;
use gleaner_report::format::{
    counted, fault_kind, gist, grouped, seconds, three_digits, without_numbers,
};

mod check_report;
mod clips;
mod diff;
mod drive;
mod inference;
mod ingress;
mod isolation;
mod live;

pub(crate) use check_report::check_report;
pub(crate) use diff::diff;
pub(crate) use drive::drive;
pub(crate) use inference::{inference, inference_event};
pub(crate) use ingress::ingress;
pub(crate) use isolation::isolation;
pub(crate) use live::{
    clip_line, decision, in_ms, live, live_losses, named_report, or_dash, recorder, table, topics,
};

/// Formats a report as one line of JSON. It also escapes the characters that act on a terminal,
/// which are in strings only.
pub(crate) fn json_line<T: serde::Serialize>(result: &T) -> String {
    let json =
        serde_json::to_string(result).expect("a report has only text keys and finite numbers");
    let mut line = String::with_capacity(json.len() + 1);
    for character in json.chars() {
        match visible(character.encode_utf8(&mut [0; 4])).starts_with(character) {
            true => line.push(character),
            false => line += &format!("\\u{:04x}", u32::from(character)),
        }
    }
    line + "\n"
}

fn written(write: impl FnOnce(&mut String) -> fmt::Result) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = write(&mut text);
    text
}

/// Maximum number of shown trigger bursts, and of shown fault groups; the others are counted.
const SHOWN: usize = 20;

/// Shown characters of a fault's message; `decisions.jsonl` has the whole message.
const MESSAGE_CHARS: usize = 200;

/// Triggers with one label and a smaller distance than this are one burst: most lambdas trigger on
/// several samples of an event.
const BURST_GAP_S: f64 = 1.0;

/// A bounded extract of the decisions for display.
#[derive(Debug, Default)]
pub(crate) struct Digest {
    triggers: Vec<Burst>,
    other_triggers: u64,
    fault_groups: Vec<FaultGroup>,
    other_faults: u64,
}

/// Consecutive triggers with one label.
#[derive(Debug)]
struct Burst {
    label: String,
    count: u64,
    first_seconds: f64,
    last_seconds: f64,
    highest_score: Option<f64>,
}

/// Faults with the same kind and message, but for its numbers.
#[derive(Debug)]
struct FaultGroup {
    kind: FaultKind,
    key: String,
    message: String,
    count: u64,
    first_seconds: f64,
}

impl Digest {
    /// Digests the `decisions` of a drive that starts at `start_ns`.
    pub(crate) fn of(
        decisions: impl Iterator<Item = Result<Decision, ResultsError>>,
        start_ns: i64,
    ) -> Result<Digest, ResultsError> {
        let mut digest = Digest::default();
        for decision in decisions {
            let decision = decision?;
            let seconds = seconds(decision.at_ns, start_ns);
            for trigger in &decision.triggers {
                digest.add(trigger, seconds);
            }
            if let Some(fault) = decision.fault {
                digest.count(&fault, seconds);
            }
        }
        Ok(digest)
    }

    fn add(&mut self, trigger: &Trigger, seconds: f64) {
        if self.other_triggers > 0 {
            self.other_triggers += 1;
            return;
        }
        let label = match trigger.kind {
            TriggerKind::Event => visible(&trigger.label),
            kind => format!("{}, {}", visible(&trigger.label), kind.as_str()),
        };
        let full = self.triggers.len() == SHOWN;
        match self.triggers.last_mut() {
            Some(burst) if burst.label == label && seconds - burst.last_seconds < BURST_GAP_S => {
                burst.count += 1;
                burst.last_seconds = seconds;
                burst.highest_score =
                    burst.highest_score.into_iter().chain(trigger.score).reduce(f64::max);
            }
            _ if full => self.other_triggers = 1,
            _ => self.triggers.push(Burst {
                label,
                count: 1,
                first_seconds: seconds,
                last_seconds: seconds,
                highest_score: trigger.score,
            }),
        }
    }

    fn count(&mut self, fault: &Fault, first_seconds: f64) {
        let (kind, message) = (fault.kind, shown(gist(&fault.message)));
        let key = without_numbers(&message);
        if let Some(cause) =
            self.fault_groups.iter_mut().find(|cause| cause.kind == kind && cause.key == key)
        {
            cause.count += 1;
        } else if self.fault_groups.len() < SHOWN {
            self.fault_groups.push(FaultGroup { kind, key, message, count: 1, first_seconds });
        } else {
            self.other_faults += 1;
        }
    }
}

impl Burst {
    fn time(&self) -> String {
        let [first, last] =
            [self.first_seconds, self.last_seconds].map(|seconds| format!("{seconds:.3}"));
        if first == last { format!("{first:>10} s") } else { format!("{first:>10} to {last} s") }
    }

    /// Returns the score of a single trigger; of several, their number and highest score.
    fn extent(&self) -> String {
        let score = self.highest_score.map(three_digits);
        match (self.count, score) {
            (1, score) => score.unwrap_or("-".to_owned()),
            (count, None) => format!("{}x", grouped(count)),
            (count, Some(score)) => format!("{}x, max {score}", grouped(count)),
        }
    }
}

/// Returns a fault's message, escaped and cut to [`MESSAGE_CHARS`].
pub(crate) fn shown(message: &str) -> String {
    // Escaping makes the text longer.
    let text = visible(&message.chars().take(MESSAGE_CHARS + 1).collect::<String>());
    match text.char_indices().nth(MESSAGE_CHARS) {
        Some((end, _)) => format!("{} … (complete in decisions.jsonl)", &text[..end]),
        None => text,
    }
}

pub(crate) fn summary(
    summary: &ReplaySummary,
    digest: &Digest,
    clips: &[Clip],
    paint: Paint,
) -> String {
    written(|text| write_summary(text, summary, digest, clips, paint))
}

pub(crate) fn verified(verified: &Verified, paint: Paint) -> String {
    written(|text| write_verified(text, verified, paint))
}

fn write_verified(text: &mut String, verified: &Verified, paint: Paint) -> fmt::Result {
    let name = visible(&verified.lambda);
    let compared = counted(verified.wakes.saturating_sub(verified.uncovered), "decision");
    let triggers =
        counted(verified.triggers.saturating_sub(verified.uncovered_triggers), "trigger");
    let same = format!("{compared} with {triggers} repeated, all identical");
    writeln!(text, "{}: {}", paint.bold(&name), paint.green(&same))?;
    if verified.uncovered > 0 {
        let wakes = counted(verified.uncovered, "wake");
        let triggers = counted(verified.uncovered_triggers, "trigger");
        let why = "not compared: the lambda read samples from before the clip";
        writeln!(text, "  {}", paint.yellow(&format!("{wakes} with {triggers} {why}")))?;
    }
    if verified.truncated {
        let why = "the journal is truncated: its writer died, or the drive was damaged; compared \
                   up to its end";
        writeln!(text, "  {}", paint.yellow(why))?;
    }
    for note in &verified.notes {
        writeln!(text, "  {}", paint.yellow(&visible(note)))?;
    }
    writeln!(text, "  {:.3} s", verified.wall_s)
}

fn write_summary(
    text: &mut String,
    summary: &ReplaySummary,
    digest: &Digest,
    clips: &[Clip],
    paint: Paint,
) -> fmt::Result {
    let name = format!("{} {}", visible(&summary.lambda), visible(&summary.version));
    let from_ns = summary.part.from_ns.unwrap_or(summary.start_ns).max(summary.start_ns);
    let to_ns = summary.part.to_ns.unwrap_or(summary.end_ns).min(summary.end_ns);
    let span_s = seconds(to_ns, from_ns);
    writeln!(
        text,
        "{} ({}): {} in {}, {span_s:.1} s of drive",
        paint.bold(&name),
        summary.kind.as_str(),
        counted(summary.triggers, "trigger"),
        counted(summary.wakes, "wake"),
    )?;

    for burst in &digest.triggers {
        writeln!(text, "{}  {}  {}", paint.green(&burst.time()), burst.label, burst.extent())?;
    }
    more(text, digest.other_triggers)?;

    write_faults(text, summary.faults, digest, paint)?;
    clips::write(text, clips, summary, paint)?;
    write_counted(text, &summary.recording, paint)?;
    if summary.clips_replaced > 0 {
        let clips = counted(summary.clips_replaced, "clip");
        writeln!(text, "  {}", paint.dim(&format!("replaced: {clips} of an earlier replay")))?;
    }
    write_losses(text, summary, paint)?;
    write_early_end(text, summary, paint)?;

    if !summary.part.is_all() {
        let [from_s, to_s] = [from_ns, to_ns].map(|ns| seconds(ns, summary.start_ns));
        let line = format!("part of the drive: from {from_s:.3} s to {to_s:.3} s");
        writeln!(text, "  {}", paint.dim(&line))?;
    }
    for model in &summary.models {
        writeln!(text, "  {}", paint.dim(&visible(model)))?;
    }
    write!(text, "  {} wakes/s", grouped(summary.wakes_per_s.round() as u64))?;
    if summary.wall_s > 0.0 && span_s > 0.0 {
        write!(text, " ({}x real time)", grouped((span_s / summary.wall_s).round() as u64))?;
    }
    write!(text, ", total run time {:.3} s", summary.run_s)?;
    if summary.decode_s > 0.0 {
        let share = 100.0 * summary.decode_s / summary.run_s.max(summary.decode_s);
        write!(text, " ({share:.0} % decoding)")?;
    }
    writeln!(text, ", peak memory {:.1} MiB", mib(summary.peak_rss_bytes))?;
    let clips = if clips.is_empty() { "" } else { ", clips.jsonl, clips/" };
    let files = format!(
        "{}: decisions.jsonl, log.jsonl, summary.json{clips}",
        visible(&summary.out.to_string_lossy())
    );
    writeln!(text, "  {}", paint.dim(&files))
}

fn write_faults(text: &mut String, faults: u64, digest: &Digest, paint: Paint) -> fmt::Result {
    if faults == 0 {
        return Ok(());
    }
    writeln!(text, "  {}", paint.red(&counted(faults, "fault")))?;
    for cause in &digest.fault_groups {
        let FaultGroup { kind, message, count, first_seconds, .. } = cause;
        let (kind, count) = (fault_kind(*kind), grouped(count));
        writeln!(text, "{first_seconds:>10.3} s  {count}x {kind}: {message}")?;
    }
    more(text, digest.other_faults)
}

fn write_losses(text: &mut String, summary: &ReplaySummary, paint: Paint) -> fmt::Result {
    for loss in losses(summary) {
        writeln!(text, "  {}", paint.yellow(&format!("lost: {loss}")))?;
    }
    if summary.out_of_order > 0 {
        let messages = counted(summary.out_of_order, "message");
        let line = format!("out of order: {messages} came after one with a later log time");
        writeln!(text, "  {}", paint.yellow(&line))?;
    }
    for (topic, messages) in &summary.malformed {
        let (topic, messages) = (visible(topic), counted(*messages, "message"));
        let line = format!("malformed: {messages} of `{topic}`, left out");
        writeln!(text, "  {}", paint.yellow(&line))?;
    }
    Ok(())
}

/// Writes the reason why the results end before the drive, if they do.
fn write_early_end(text: &mut String, summary: &ReplaySummary, paint: Paint) -> fmt::Result {
    if let Some(damage) = &summary.damaged {
        writeln!(text, "  {}", paint.red("the drive is damaged"))?;
        for line in damage.lines() {
            writeln!(text, "    {}", visible(line))?;
        }
    }
    if let Some(why) = &summary.stopped {
        let what = "the lambda's process ended before the drive; the results end there";
        writeln!(text, "  {}", paint.red(what))?;
        writeln!(text, "    {}", visible(why))?;
    }
    Ok(())
}

/// Writes a line for each cause of data that the recorder did not record.
fn write_counted(text: &mut String, recording: &RecordingCounts, paint: Paint) -> fmt::Result {
    for counted in recording.by_cause().into_iter().filter(|counted| counted.count > 0) {
        let line = counted.describe();
        let line = match counted.outcome {
            LossOutcome::NoWindow => paint.dim(&line),
            _ => paint.yellow(&line),
        };
        writeln!(text, "  {line}")?;
    }
    Ok(())
}

fn more(text: &mut String, count: u64) -> fmt::Result {
    if count > 0 {
        writeln!(text, "{:>12}  and {} more", "", grouped(count))?;
    }
    Ok(())
}

/// Causes of losses, of a replay and live.
const OVER_RATE: &str = "over the rate limit";
const OVER_EVENTS: &str = "refused: over `events_per_minute`";
const BACKED_OFF: &str = "skipped: backing off after repeated faults";

/// Returns a line for each loss, with its cause. Samples that newer ones overwrote in a ring do not
/// count as lost.
fn losses(summary: &ReplaySummary) -> Vec<String> {
    let of_topic = |topic: &TopicReport| {
        let causes = [
            (topic.lost.unwrap_or(0), "upstream"),
            (topic.no_slot, "no free slot: the lambda holds too many"),
            (topic.too_big, "larger than `max_size`"),
        ];
        let name = visible(&topic.topic);
        causes.map(|(count, why)| (count, format!("{} of {name}, {why}", counted(count, "sample"))))
    };
    let overall = [
        (summary.skipped, "event sample", "skipped"),
        (summary.missed_ticks, "tick", "missed"),
        (summary.log_dropped, "log line", OVER_RATE),
        (summary.triggers_refused, "trigger", OVER_EVENTS),
        (summary.backed_off, "wake", BACKED_OFF),
    ]
    .map(|(count, thing, why)| (count, format!("{}, {why}", counted(count, thing))));
    let all = summary.topics.iter().flat_map(of_topic).chain(overall);
    all.filter(|(count, _)| *count > 0).map(|(_, loss)| loss).collect()
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / (1024.0 * 1024.0)
}

/// The sequences of [`Paint`]: its colours, and their end.
const COLOURS: [&str; 6] =
    ["\u{1b}[0m", "\u{1b}[1m", "\u{1b}[2m", "\u{1b}[31m", "\u{1b}[32m", "\u{1b}[33m"];

/// Terminal colours, if enabled.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Paint {
    on: bool,
}

impl Paint {
    /// Enables colours on a terminal, unless `NO_COLOR` is set.
    ///
    /// Source: no-color.org, by which an empty `NO_COLOR` counts as unset.
    pub(crate) fn new(terminal: bool) -> Paint {
        Paint { on: terminal && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()) }
    }

    /// Enables colours if standard output is a terminal.
    pub(crate) fn of_stdout() -> Paint {
        Paint::new(io::stdout().is_terminal())
    }

    /// Enables colours if standard error is a terminal.
    pub(crate) fn of_stderr() -> Paint {
        Paint::new(io::stderr().is_terminal())
    }

    pub(crate) fn bold(self, text: &str) -> String {
        self.with(COLOURS[1], text)
    }

    pub(crate) fn dim(self, text: &str) -> String {
        self.with(COLOURS[2], text)
    }

    pub(crate) fn red(self, text: &str) -> String {
        self.with(COLOURS[3], text)
    }

    pub(crate) fn green(self, text: &str) -> String {
        self.with(COLOURS[4], text)
    }

    pub(crate) fn yellow(self, text: &str) -> String {
        self.with(COLOURS[5], text)
    }

    fn with(self, colour: &str, text: &str) -> String {
        if self.on { format!("{colour}{text}{}", COLOURS[0]) } else { text.to_owned() }
    }

    /// Escapes what acts on a terminal, but for line ends and tabs, and for these colours if they
    /// are enabled. Untrusted text that did not pass `visible` before can set them, and nothing
    /// else.
    pub(crate) fn escaped(self, text: &str) -> String {
        fn without(kept: &[&str], text: &str) -> String {
            let Some((&first, others)) = kept.split_first() else { return visible(text) };
            let parts = text.split(first).map(|part| without(others, part));
            parts.collect::<Vec<_>>().join(first)
        }
        let colours = if self.on { &COLOURS[..] } else { &[] };
        without(&[&["\n", "\t"][..], colours].concat(), text)
    }
}

#[cfg(test)]
mod tests;
