//! Collects the data of the page from the result files. Data that cannot be read is omitted with a
//! note.

use std::collections::HashMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use gleaner_base::{NotPlain, visible};
use gleaner_lambda::signals::{Curve, Distribution, Signals};
use gleaner_lambda::{Clip, Decision};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::events::{Events, TextBudget};
use super::model::{Fact, PageClip, PageCurve, PageLogLine, PageRun, PageSpread, Totals};
use super::pictures::Pictures;
use crate::format::{clip_contents, clip_span, counted, cut, grouped, seconds, size};
use crate::results::{JsonLines, ResultsError};
use crate::run_summary::{OutputError, RunSummary, describe, shown_config, signals};

const CLIPS_MAX: usize = 1_000;
pub(super) const LOG_MAX: usize = 2_000;
const LOG_CHARS: usize = 1_000;
const NOTE_CHARS: usize = 1_000;

/// Byte budget for the texts of triggers. Faults, clips and the log have half of it each.
const TEXT_BYTES: usize = 2 << 20;

#[derive(Deserialize)]
struct UntrustedLogLine {
    at_ns: i64,
    level: String,
    message: String,
}

/// Collects the data of the run in `out`. Its budgets are divided by `shares`, the number of runs
/// on the page. Times count from `from_ns`; by default from the start of the run.
pub(crate) fn collect(
    out: &Path,
    shares: usize,
    from_ns: Option<i64>,
) -> Result<PageRun, OutputError> {
    let mut notes = Vec::new();
    let summary = RunSummary::bounded(out, &mut notes)?;
    let signals = signals(out, &mut notes)?;
    let begin_ns = match &summary {
        RunSummary::Replay(replay) => replay.start_ns,
        RunSummary::Live(_) => first_ns(out).unwrap_or(0),
    };
    let start_ns = from_ns.unwrap_or(begin_ns);

    let mut items = RunItems::read(out, start_ns, TEXT_BYTES / shares, &mut notes)?;
    let mut pictures = Pictures::new(out, start_ns, shares);
    let of_triggers = signals.as_ref().map_or(&[][..], |signals| &signals.pictures);
    pictures.at_triggers(&mut items.events.triggers, of_triggers);
    pictures.of_clips(&mut items.events.triggers, &items.clips, &items.thumbnails);
    notes.extend(pictures.note());

    let config = signals.as_ref().map(|signals| shown_config(&signals.config, &mut notes));
    // Notes may quote texts of the files.
    let notes = notes.iter().map(|note| cut(note, NOTE_CHARS)).collect();
    let (name, version, kind) = summary.lambda();
    let totals = items.totals(pictures.omitted, signals.as_ref());
    let RunItems { events, log, clips, last_ns, .. } = items;
    let curves = signals.iter().flat_map(|signals| &signals.curves);
    let mut run = PageRun {
        out: out.display().to_string(),
        lambda: name.to_owned(),
        version: version.to_owned(),
        kind,
        is_live: matches!(summary, RunSummary::Live(_)),
        drive: Vec::new(),
        start_ns,
        start_ms: start_ns as f64 / 1e6,
        from: seconds(begin_ns, start_ns),
        to: seconds(last_ns.max(begin_ns), start_ns),
        is_part: false,
        config,
        counts: summary.wakes().into_iter().collect(),
        damaged: None,
        stopped: None,
        notes,
        facts: facts(&summary),
        totals,
        trigger_density: events.trigger_density.bins_beyond(events.triggers.len()),
        fault_density: events.fault_density.bins_beyond(events.faults.len()),
        labels: events.labels,
        triggers: events.triggers,
        fault_kinds: events.fault_kinds,
        faults: events.faults,
        fault_causes: events.causes,
        clips,
        curves: curves.map(|curve| curve_shown(curve, start_ns)).collect(),
        spreads: spreads(&summary, signals.as_ref()),
        topics: summary.topics(),
        missed: summary.missed(),
        pictures: pictures.shown,
        log,
    };
    set_drive(&mut run, &summary);
    Ok(run)
}

/// Decisions, log lines and clips of a run, within the budgets of the page.
struct RunItems {
    events: Events,
    log: Vec<PageLogLine>,
    log_seen: u64,
    clips: Vec<PageClip>,
    clips_seen: u64,
    /// One entry for each of `clips`.
    thumbnails: Vec<Option<PathBuf>>,
    /// End of the last item; [`i64::MIN`] if there is none.
    last_ns: i64,
}

impl RunItems {
    /// Reads the items of the run in `out`. Times count from `start_ns`; texts of triggers may take
    /// `budget` bytes.
    fn read(
        out: &Path,
        start_ns: i64,
        budget: usize,
        notes: &mut Vec<String>,
    ) -> Result<Self, ResultsError> {
        let mut events = Events::new(start_ns, budget);
        let mut last_ns = i64::MIN;
        each(out, "decisions.jsonl", true, notes, |decision: Decision| {
            last_ns = last_ns.max(decision.at_ns);
            events.add(&decision);
        })?;

        let (mut log, mut log_seen, mut log_budget) = (Vec::new(), 0, TextBudget(budget / 2));
        each(out, "log.jsonl", true, notes, |line: UntrustedLogLine| {
            last_ns = last_ns.max(line.at_ns);
            log_seen += 1;
            let (t, level) = (seconds(line.at_ns, start_ns), cut(&line.level, 12));
            let shown = PageLogLine { t, level, message: cut(&line.message, LOG_CHARS) };
            if log.len() < LOG_MAX && log_budget.take(&shown) {
                log.push(shown);
            }
        })?;

        let (mut clips, mut clips_seen, mut clip_budget) = (Vec::new(), 0, TextBudget(budget / 2));
        let mut thumbnails = Vec::new();
        // A run without [record] has no clips.
        each(out, "clips.jsonl", false, notes, |clip: Clip| {
            last_ns = last_ns.max(clip_span(&clip)[1]);
            clips_seen += 1;
            let shown = clip_shown(&clip, start_ns);
            if clips.len() < CLIPS_MAX && clip_budget.take(&shown) {
                thumbnails.push(clip.thumbnail);
                clips.push(shown);
            }
        })?;
        Ok(Self { events, log, log_seen, clips, clips_seen, thumbnails, last_ns })
    }

    fn totals(&self, pictures_omitted: u64, signals: Option<&Signals>) -> Totals {
        let omitted = signals.map_or((0, 0), |it| (it.pictures_omitted, it.curves_omitted));
        Totals {
            triggers: self.events.triggers_seen,
            faults: self.events.faults_seen,
            unlisted_faults: self.events.unlisted_faults,
            clips: self.clips_seen,
            pictures_omitted: pictures_omitted.saturating_add(omitted.0),
            curves_omitted: omitted.1,
            log: self.log_seen,
        }
    }
}

fn set_drive(run: &mut PageRun, summary: &RunSummary) {
    let RunSummary::Replay(replay) = summary else { return };
    run.drive = replay.drive.iter().map(|path| path.display().to_string()).collect();
    let part = replay.part;
    let from_ns = part.from_ns.unwrap_or(replay.start_ns).max(replay.start_ns);
    let to_ns = part.to_ns.unwrap_or(replay.end_ns).min(replay.end_ns);
    run.from = seconds(from_ns, run.start_ns);
    run.to = seconds(to_ns.max(from_ns), run.start_ns);
    run.is_part = !part.is_all();
    run.damaged.clone_from(&replay.damaged);
    run.stopped.clone_from(&replay.stopped);
}

/// Calls `take` with each value of the file `name`. Lines that cannot be parsed are counted in
/// `notes`.
///
/// # Errors
///
/// [`ResultsError::Read`] if the file is a link or a pipe, or too long. No run writes such a file,
/// and a page without it would hide that.
fn each<T: DeserializeOwned>(
    out: &Path,
    name: &str,
    is_expected: bool,
    notes: &mut Vec<String>,
    mut take: impl FnMut(T),
) -> Result<(), ResultsError> {
    let path: PathBuf = out.join(name);
    let lines = match JsonLines::read(path) {
        Ok(lines) => lines,
        Err(ResultsError::Read { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
            if is_expected {
                notes.push(format!("`{name}` is missing"));
            }
            return Ok(());
        }
        Err(ResultsError::Read { path, source }) if NotPlain::of(&source).is_some() => {
            return Err(ResultsError::Read { path, source });
        }
        Err(error) => {
            notes.push(describe(&error));
            return Ok(());
        }
    };
    let (mut bad, mut first) = (0_u64, String::new());
    for line in lines {
        match line {
            Ok(value) => take(value),
            Err(error @ ResultsError::Read { .. }) => notes.push(describe(&error)),
            Err(error) => {
                if bad == 0 {
                    first = describe(&error);
                }
                bad += 1;
            }
        }
    }
    if bad > 0 {
        notes.push(format!("{} of `{name}` omitted; the first: {first}", counted(bad, "line")));
    }
    Ok(())
}

/// Returns the time of the first decision, log line or clip of a live run, whose start is not
/// recorded.
fn first_ns(out: &Path) -> Option<i64> {
    #[derive(Deserialize)]
    struct At {
        at_ns: i64,
    }
    let first =
        |name| JsonLines::<At>::read(out.join(name)).ok()?.flatten().next().map(|at| at.at_ns);
    let clip = JsonLines::<Clip>::read(out.join("clips.jsonl"))
        .ok()
        .and_then(|clips| clips.flatten().next());
    let clip = clip.map(|clip| clip_span(&clip)[0]);
    [first("decisions.jsonl"), first("log.jsonl"), clip].into_iter().flatten().min()
}

fn clip_shown(clip: &Clip, start_ns: i64) -> PageClip {
    let span_ns = clip_span(clip);
    let mut incomplete: Vec<_> = clip.incomplete.iter().take(20).map(|why| cut(why, 300)).collect();
    incomplete.extend(
        clip.recovered.iter().map(|recovered| format!("recovered: {}", cut(&recovered.note, 300))),
    );
    let lost =
        clip.topics.iter().filter_map(|topic| Some((topic, topic.lost.filter(|lost| *lost > 0)?)));
    incomplete.extend(lost.take(20).map(|(topic, lost)| {
        format!("{} messages of {} lost upstream", grouped(lost), cut(&topic.topic, 120))
    }));
    PageClip {
        file: cut(&clip.file.to_string_lossy(), 300),
        from: seconds(span_ns[0], start_ns),
        to: seconds(span_ns[1], start_ns),
        span_ns,
        bytes: clip.bytes,
        triggers: clip.triggers,
        contents: cut(&clip_contents(clip), 600),
        incomplete,
    }
}

fn curve_shown(curve: &Curve, start_ns: i64) -> PageCurve {
    let rounded = |values: &[f64]| values.iter().copied().map(nine_digits).collect::<Vec<_>>();
    let (min, max) = (rounded(&curve.min), rounded(&curve.max));
    PageCurve {
        input: cut(&curve.input, 120),
        topic: cut(&curve.topic, 120),
        path: cut(&curve.path, 120),
        samples: curve.samples,
        non_finite: curve.non_finite,
        per_point: curve.per_point,
        t: curve
            .at_ns
            .iter()
            .map(|at_ns| (seconds(*at_ns, start_ns) * 1e6).round() / 1e6)
            .collect(),
        max: if min == max { Vec::new() } else { max },
        min,
    }
}

/// Rounds `value` to nine digits. Plots show fewer, and full precision would double the page.
fn nine_digits(value: f64) -> f64 {
    format!("{value:.8e}").parse().unwrap_or(value)
}

fn spreads(summary: &RunSummary, signals: Option<&Signals>) -> Vec<PageSpread> {
    let kept = |what, unit, spread: &Distribution| PageSpread {
        what,
        unit,
        count: spread.count,
        quantiles: vec![
            ("p50", spread.p50),
            ("p90", spread.p90),
            ("p99", spread.p99),
            ("max", spread.max),
        ],
        bins: spread.bins.iter().take(1000).map(|bin| [bin.from, bin.to, bin.count]).collect(),
    };
    if let Some(signals) = signals {
        let fuel = signals.fuel.iter().map(|fuel| kept("fuel", "fuel", fuel));
        return std::iter::once(kept("run time", "ns", &signals.run_ns)).chain(fuel).collect();
    }
    let RunSummary::Live(live) = summary else { return Vec::new() };
    let spreads = [
        ("wake latency", live.wake_latency),
        ("run time", live.run_time),
        ("decision latency", live.decision_latency),
    ];
    let shown = spreads.into_iter().filter_map(|(what, spread)| Some((what, spread?)));
    let shown = shown.map(|(what, spread)| PageSpread {
        what,
        unit: "ns",
        count: spread.n,
        quantiles: vec![("p50", spread.p50_ns), ("p99", spread.p99_ns), ("max", spread.max_ns)],
        bins: Vec::new(),
    });
    shown.collect()
}

fn facts(summary: &RunSummary) -> Vec<Fact> {
    let fact = |what, text: String| Fact { what, text };
    match summary {
        RunSummary::Replay(summary) => {
            let percent = 100.0 * summary.decode_s
                / summary.run_s.max(summary.decode_s).max(f64::MIN_POSITIVE);
            let decoding = if summary.decode_s > 0.0 {
                format!(", {percent:.0} % decoding")
            } else {
                String::new()
            };
            let facts = [
                fact("total run time", format!("{:.3} s{decoding}", summary.run_s)),
                fact("replayed in", format!("{:.3} s", summary.wall_s)),
                fact("speed", format!("{} wakes/s", grouped(summary.wakes_per_s.round() as u64))),
                fact("peak memory", size(summary.peak_rss_bytes)),
            ];
            let models = summary.models.iter().take(8);
            let models = models.map(|model| fact("ran on", cut(&visible(model), 300)));
            facts.into_iter().chain(models).collect()
        }
        RunSummary::Live(summary) => {
            let qos_warnings = summary.topics.iter().flat_map(|topic| &topic.qos_warnings);
            let facts = [
                fact("uptime", format!("{:.1} s", summary.up_s)),
                fact("CPU time", format!("{:.1} s", summary.cpu_s)),
                fact("memory", size(summary.rss_bytes)),
                fact("restarts", summary.restarts.to_string()),
            ];
            facts
                .into_iter()
                .chain(qos_warnings.take(8).map(|why| fact("QoS warning", visible(why))))
                .collect()
        }
    }
}

pub(super) fn positions<K: std::hash::Hash + Eq>(
    keys: impl Iterator<Item = K>,
) -> HashMap<K, Vec<usize>> {
    let mut positions: HashMap<K, Vec<usize>> = HashMap::new();
    for (position, key) in keys.enumerate() {
        positions.entry(key).or_default().push(position);
    }
    positions
}

/// Returns `value` in backquotes, for a note.
pub(super) fn named(value: impl Display) -> String {
    format!("`{}`", visible(&value.to_string()))
}
