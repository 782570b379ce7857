//! The data of the page out of the files of an output. What cannot be used is left out, and the
//! page says so.

use std::collections::HashMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use gleaner_base::{NotPlain, visible};
use gleaner_lambda::signals::{Curve, Signals, Spread};
use gleaner_lambda::{Clip, Decision};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::marks::{Marks, Room};
use super::model::{ClipShown, CurveShown, Fact, LogShown, Run, SpreadShown, Totals};
use super::pictures::Pictures;
use crate::results::{JsonLines, ResultsError};
use crate::run_summary::{OutputError, RunSummary, in_words, shown_config, signals};
use crate::words::{clip_contents, clip_span, counted, cut, grouped, seconds, size};

/// Most clips and lines of the log on a page.
const CLIPS_MAX: usize = 1_000;
pub(super) const LOG_MAX: usize = 2_000;
const LOG_CHARS: usize = 1_000;
const NOTE_CHARS: usize = 1_000;

/// Bytes that the texts of triggers may take; those of faults, clips and the log each half of it.
const TEXT_BYTES: usize = 2 << 20;

/// A line of `log.jsonl`.
#[derive(Deserialize)]
struct Line {
    at_ns: i64,
    level: String,
    message: String,
}

/// What the page shows of `out`, which shares it with others: it has one part of `shares`. Times
/// count from `from_ns`; of a run that is alone, from its own start.
pub(crate) fn gather(out: &Path, shares: usize, from_ns: Option<i64>) -> Result<Run, OutputError> {
    let mut notes = Vec::new();
    let told = RunSummary::bounded(out, &mut notes)?;
    let signals = signals(out, &mut notes)?;
    let begin_ns = match &told {
        RunSummary::Replay(summary) => summary.start_ns,
        RunSummary::Live(_) => first_ns(out).unwrap_or(0),
    };
    let start_ns = from_ns.unwrap_or(begin_ns);

    let room = TEXT_BYTES / shares;
    let mut marks = Marks::new(start_ns, room);
    let mut last_ns = begin_ns;
    each(out, "decisions.jsonl", true, &mut notes, |decision: Decision| {
        last_ns = last_ns.max(decision.at_ns);
        marks.add(&decision);
    })?;

    let (mut log, mut log_seen, mut log_room) = (Vec::new(), 0, Room(room / 2));
    each(out, "log.jsonl", true, &mut notes, |line: Line| {
        last_ns = last_ns.max(line.at_ns);
        log_seen += 1;
        let (t, level) = (seconds(line.at_ns, start_ns), cut(&line.level, 12));
        let shown = LogShown { t, level, message: cut(&line.message, LOG_CHARS) };
        if log.len() < LOG_MAX && log_room.take(&shown) {
            log.push(shown);
        }
    })?;

    let (mut clips, mut clips_seen, mut clip_room) = (Vec::new(), 0, Room(room / 2));
    let mut thumbnails = Vec::new();
    // A run without [record] has none.
    each(out, "clips.jsonl", false, &mut notes, |clip: Clip| {
        last_ns = last_ns.max(clip_span(&clip)[1]);
        clips_seen += 1;
        let shown = clip_shown(&clip, start_ns);
        if clips.len() < CLIPS_MAX && clip_room.take(&shown) {
            thumbnails.push(clip.thumbnail);
            clips.push(shown);
        }
    })?;

    let mut pictures = Pictures::new(out, start_ns, shares);
    pictures.at_triggers(
        &mut marks.triggers,
        signals.as_ref().map_or(&[][..], |signals| &signals.pictures),
    );
    pictures.of_clips(&mut marks.triggers, &clips, &thumbnails);
    notes.extend(pictures.note());

    let config = signals.as_ref().map(|signals| shown_config(&signals.config, &mut notes));
    // Some quote what was found in a file.
    let notes = notes.iter().map(|note| cut(note, NOTE_CHARS)).collect();
    let (name, version, kind) = told.lambda();
    let mut run = Run {
        out: out.display().to_string(),
        lambda: name.to_owned(),
        version: version.to_owned(),
        kind,
        is_live: matches!(told, RunSummary::Live(_)),
        drive: Vec::new(),
        start_ns,
        start_ms: start_ns as f64 / 1e6,
        from: seconds(begin_ns, start_ns),
        to: seconds(last_ns, start_ns),
        is_part: false,
        config,
        counts: told.wakes().into_iter().collect(),
        damaged: None,
        stopped: None,
        notes,
        facts: facts(&told),
        totals: Totals {
            triggers: marks.triggers_seen,
            faults: marks.faults_seen,
            faults_in_no_line: marks.faults_in_no_line,
            clips: clips_seen,
            pictures_omitted: pictures
                .left_out
                .saturating_add(signals.as_ref().map_or(0, |signals| signals.pictures_omitted)),
            curves_omitted: signals.as_ref().map_or(0, |signals| signals.curves_omitted),
            log: log_seen,
        },
        trigger_density: match marks.triggers_seen > marks.triggers.len() as u64 {
            true => marks.trigger_density.bins(),
            false => Vec::new(),
        },
        fault_density: match marks.faults_seen > marks.faults.len() as u64 {
            true => marks.fault_density.bins(),
            false => Vec::new(),
        },
        labels: marks.labels,
        triggers: marks.triggers,
        fault_kinds: marks.fault_kinds,
        faults: marks.faults,
        fault_causes: marks.causes,
        clips,
        curves: signals
            .iter()
            .flat_map(|signals| &signals.curves)
            .map(|curve| curve_shown(curve, start_ns))
            .collect(),
        spreads: spreads(&told, signals.as_ref()),
        topics: told.topics(),
        missed: told.missed(),
        pictures: pictures.shown,
        log,
    };
    place(&mut run, &told);
    Ok(run)
}

/// Which drive it was, and what of it.
fn place(run: &mut Run, told: &RunSummary) {
    let RunSummary::Replay(summary) = told else { return };
    run.drive = summary.drive.iter().map(|path| path.display().to_string()).collect();
    let part = summary.part;
    let from_ns = part.from_ns.unwrap_or(summary.start_ns).max(summary.start_ns);
    let to_ns = part.to_ns.unwrap_or(summary.end_ns).min(summary.end_ns);
    run.from = seconds(from_ns, run.start_ns);
    run.to = seconds(to_ns.max(from_ns), run.start_ns);
    run.is_part = !part.is_all();
    run.damaged.clone_from(&summary.damaged);
    run.stopped.clone_from(&summary.stopped);
}

/// Gives `take` what each line of `name` says. Lines that say nothing are counted in `notes`.
///
/// # Errors
///
/// If the file is a link, or something else that no run leaves: a page without it would hide that.
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
                notes.push(format!("`{name}` is not there: the page does without"));
            }
            return Ok(());
        }
        Err(ResultsError::Read { path, source }) if NotPlain::of(&source).is_some() => {
            return Err(ResultsError::Read { path, source });
        }
        Err(error) => {
            notes.push(in_words(&error));
            return Ok(());
        }
    };
    let (mut bad, mut first) = (0_u64, String::new());
    for line in lines {
        match line {
            Ok(value) => take(value),
            Err(error @ ResultsError::Read { .. }) => notes.push(in_words(&error)),
            Err(error) => {
                if bad == 0 {
                    first = in_words(&error);
                }
                bad += 1;
            }
        }
    }
    if bad > 0 {
        notes.push(format!("{} of `{name}` left out; the first: {first}", counted(bad, "line")));
    }
    Ok(())
}

/// When a live run is seen for the first time: nothing else tells when it began.
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

fn clip_shown(clip: &Clip, start_ns: i64) -> ClipShown {
    let span_ns = clip_span(clip);
    let mut short: Vec<_> = clip.short.iter().take(20).map(|why| cut(why, 300)).collect();
    short.extend(
        clip.recovered.iter().map(|recovered| format!("recovered: {}", cut(&recovered.what, 300))),
    );
    let lost =
        clip.topics.iter().filter_map(|topic| Some((topic, topic.lost.filter(|lost| *lost > 0)?)));
    short.extend(lost.take(20).map(|(topic, lost)| {
        format!(
            "{} messages of {} lost before they reached the recorder",
            grouped(lost),
            cut(&topic.topic, 120)
        )
    }));
    ClipShown {
        file: cut(&clip.file.to_string_lossy(), 300),
        from: seconds(span_ns[0], start_ns),
        to: seconds(span_ns[1], start_ns),
        span_ns,
        bytes: clip.bytes,
        triggers: clip.triggers,
        contents: cut(&clip_contents(clip), 600),
        short,
    }
}

fn curve_shown(curve: &Curve, start_ns: i64) -> CurveShown {
    let rounded = |values: &[f64]| values.iter().copied().map(nine_digits).collect::<Vec<_>>();
    let (min, max) = (rounded(&curve.min), rounded(&curve.max));
    CurveShown {
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

/// `value` to nine digits: no plot shows more, and all of them would double the page.
fn nine_digits(value: f64) -> f64 {
    format!("{value:.8e}").parse().unwrap_or(value)
}

fn spreads(told: &RunSummary, signals: Option<&Signals>) -> Vec<SpreadShown> {
    let kept = |what, unit, spread: &Spread| SpreadShown {
        what,
        unit,
        count: spread.count,
        marks: vec![
            ("half", spread.p50),
            ("90 %", spread.p90),
            ("99 %", spread.p99),
            ("most", spread.max),
        ],
        bins: spread.bins.iter().take(1000).map(|bin| [bin.from, bin.to, bin.count]).collect(),
    };
    if let Some(signals) = signals {
        let fuel = signals.fuel.iter().map(|fuel| kept("fuel", "fuel", fuel));
        return std::iter::once(kept("time in the lambda", "ns", &signals.run_ns))
            .chain(fuel)
            .collect();
    }
    let RunSummary::Live(live) = told else { return Vec::new() };
    let spreads = [
        ("wake-up", live.wake_latency),
        ("time in the lambda", live.run),
        ("decision handed out", live.decision_latency),
    ];
    let shown = spreads.into_iter().filter_map(|(what, spread)| Some((what, spread?)));
    let shown = shown.map(|(what, spread)| SpreadShown {
        what,
        unit: "ns",
        count: spread.n,
        marks: vec![("half", spread.p50_ns), ("99 %", spread.p99_ns), ("most", spread.max_ns)],
        bins: Vec::new(),
    });
    shown.collect()
}

fn facts(told: &RunSummary) -> Vec<Fact> {
    let fact = |what, text: String| Fact { what, text };
    match told {
        RunSummary::Replay(told) => {
            let percent =
                100.0 * told.decode_s / told.run_s.max(told.decode_s).max(f64::MIN_POSITIVE);
            let decoding = if told.decode_s > 0.0 {
                format!(", {percent:.0} % decoding")
            } else {
                String::new()
            };
            vec![
                fact("in the lambda", format!("{:.3} s{decoding}", told.run_s)),
                fact("replayed in", format!("{:.3} s", told.wall_s)),
                fact("speed", format!("{} wakes/s", grouped(told.wakes_per_s.round() as u64))),
                fact("memory, at most", size(told.peak_rss_bytes)),
            ]
        }
        RunSummary::Live(told) => {
            let qos_warnings = told.topics.iter().flat_map(|topic| &topic.qos_warnings);
            let facts = [
                fact("up", format!("{:.1} s", told.up_s)),
                fact("processor time", format!("{:.1} s", told.cpu_s)),
                fact("memory", size(told.rss_bytes)),
                fact("restarts", told.restarts.to_string()),
            ];
            facts
                .into_iter()
                .chain(qos_warnings.take(8).map(|why| fact("QoS warning", visible(why))))
                .collect()
        }
    }
}

/// Which of `values` stand at which key.
pub(super) fn places<K: std::hash::Hash + Eq>(
    keys: impl Iterator<Item = K>,
) -> HashMap<K, Vec<usize>> {
    let mut places: HashMap<K, Vec<usize>> = HashMap::new();
    for (place, key) in keys.enumerate() {
        places.entry(key).or_default().push(place);
    }
    places
}

/// `value`, in words for a note.
pub(super) fn named(value: impl Display) -> String {
    format!("`{}`", visible(&value.to_string()))
}
