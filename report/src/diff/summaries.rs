//! Compares the summaries of two runs: lambda, drive, config, counts and cost.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use gleaner_lambda::Clip;
use gleaner_lambda::manifest::ConfigValue;
use gleaner_lambda::signals::Signals;
use gleaner_protocol::LiveStatus;

use super::compare::short;
use super::{ComparedRun, Cost, Diff, DiffError, ValueChange};
use crate::format::{grouped, size};
use crate::results::JsonLines;
use crate::run_summary::{RunSummary, TopicCounts, signals};

/// Maximum number of config changes that are listed.
const CHANGES_MAX: usize = 200;

/// Compares everything but the decisions.
pub(super) fn compared(a: &Path, b: &Path) -> Result<Diff, DiffError> {
    let mut notes = Vec::new();
    let (run_a, run_b) = (RunSummary::bounded(a, &mut notes)?, RunSummary::bounded(b, &mut notes)?);
    add_warnings(&run_a, &run_b, &mut notes);
    let (read_a, read_b) = (signals(a, &mut notes)?, signals(b, &mut notes)?);
    let clips = [clips(a)?, clips(b)?];
    Ok(Diff {
        a: compared_run(a, &run_a),
        b: compared_run(b, &run_b),
        config: config(read_a.as_ref(), read_b.as_ref(), &mut notes),
        counts: counts(&run_a, &run_b, clips),
        cost: cost((&run_a, read_a.as_ref()), (&run_b, read_b.as_ref())),
        notes,
        ..Diff::default()
    })
}

fn compared_run(out: &Path, run: &RunSummary) -> ComparedRun {
    let (lambda, version, kind) = run.lambda();
    let (drive, start_ns) = match run {
        RunSummary::Replay(summary) => (
            summary.drive.iter().map(|path| path.display().to_string()).collect(),
            Some(summary.start_ns),
        ),
        RunSummary::Live(_) => (Vec::new(), None),
    };
    let (lambda, version) = (lambda.to_owned(), version.to_owned());
    ComparedRun { out: out.display().to_string(), lambda, version, kind, drive, start_ns }
}

/// Adds notes on what makes the comparison doubtful. They are shown first.
fn add_warnings(a: &RunSummary, b: &RunSummary, notes: &mut Vec<String>) {
    let [(name_a, version_a, kind_a), (name_b, version_b, kind_b)] = [a.lambda(), b.lambda()];
    if name_a != name_b {
        notes.push(format!("different lambdas: `{name_a}` and `{name_b}`"));
    } else if version_a != version_b {
        notes.push(format!("different versions of `{name_a}`: {version_a} and {version_b}"));
    }
    if kind_a != kind_b {
        notes.push(format!("different kinds: {} and {}", kind_a.as_str(), kind_b.as_str()));
    }
    let (a, b) = match (a, b) {
        (RunSummary::Replay(a), RunSummary::Replay(b)) => (a, b),
        (RunSummary::Live(_), RunSummary::Live(_)) => {
            return notes.push("both ran live, each on what it received".to_owned());
        }
        _ => return notes.push("one is a replay, the other ran live".to_owned()),
    };
    if (a.start_ns, a.end_ns) != (b.start_ns, b.end_ns) {
        let names = [a, b].map(|summary| {
            summary
                .drive
                .iter()
                .map(|path| format!("`{}`", path.display()))
                .collect::<Vec<_>>()
                .join(", ")
        });
        notes.push(format!("different drives: {} and {}", names[0], names[1]));
    } else if a.part != b.part {
        notes.push("different parts of the drive".to_owned());
    }
    for (name, summary) in [("first", a), ("second", b)] {
        if summary.damaged.is_some() {
            notes.push(format!("the drive of the {name} is damaged"));
        }
    }
}

fn config(a: Option<&Signals>, b: Option<&Signals>, notes: &mut Vec<String>) -> Vec<ValueChange> {
    let (Some(a), Some(b)) = (a, b) else {
        notes
            .push("config not compared: it is unknown for a run without `signals.json`".to_owned());
        return Vec::new();
    };
    let word = |values: &BTreeMap<String, ConfigValue>, key: &str| {
        values.get(key).map(|value| serde_json::to_string(value).unwrap_or_default())
    };
    let keys: BTreeSet<_> = a.config.keys().chain(b.config.keys()).collect();
    let both = keys.into_iter().map(|key| (key, word(&a.config, key), word(&b.config, key)));
    let mut changed = both.filter(|(_, a, b)| a != b);
    let shown = |(key, a, b): (&String, Option<String>, Option<String>)| {
        let [a, b] = [a, b].map(|value| value.as_deref().map(short));
        ValueChange { what: short(key), a, b }
    };
    let changes = changed.by_ref().take(CHANGES_MAX).map(shown).collect();
    let omitted = changed.count();
    if omitted > 0 {
        notes.push(format!("{omitted} more config values differ"));
    }
    changes
}

/// Returns the number of clips and their bytes.
fn clips(out: &Path) -> Result<[u64; 2], DiffError> {
    let path = out.join("clips.jsonl");
    if !path.exists() {
        return Ok([0, 0]);
    }
    let lines = JsonLines::<Clip>::read(path).map_err(DiffError::Read)?;
    let mut found = [0, 0_u64];
    for clip in lines {
        found[0] += 1;
        found[1] = found[1].saturating_add(clip.map_err(DiffError::Read)?.bytes);
    }
    Ok(found)
}

fn counts(a: &RunSummary, b: &RunSummary, clips: [[u64; 2]; 2]) -> Vec<ValueChange> {
    let mut changes = Vec::new();
    let mut add = |what: String, a: Option<String>, b: Option<String>| {
        if a != b {
            changes.push(ValueChange { what, a, b });
        }
    };
    // All names in one order, first those that the first run has.
    let numbers =
        |run: &RunSummary| run.wakes().into_iter().chain(run.missed()).collect::<Vec<_>>();
    let (of_a, of_b) = (numbers(a), numbers(b));
    let find = |list: &[(&'static str, u64)], what: &str| {
        list.iter().find(|(name, _)| *name == what).map(|(_, count)| grouped(*count))
    };
    let only_b = of_b.iter().filter(|(what, _)| find(&of_a, what).is_none());
    for (what, _) in of_a.iter().chain(only_b) {
        add((*what).to_owned(), find(&of_a, what), find(&of_b, what));
    }
    let [[clips_a, bytes_a], [clips_b, bytes_b]] = clips;
    add("clips".to_owned(), Some(grouped(clips_a)), Some(grouped(clips_b)));
    add("size of the clips".to_owned(), Some(size(bytes_a)), Some(size(bytes_b)));

    let (of_a, of_b) = (a.topics(), b.topics());
    let counts =
        |list: &[TopicCounts], input: &str| list.iter().find(|topic| topic.input == input).cloned();
    let only_b = of_b.iter().filter(|topic| counts(&of_a, &topic.input).is_none());
    for TopicCounts { input, .. } in of_a.iter().chain(only_b) {
        let (a, b) = (counts(&of_a, input), counts(&of_b, input));
        type Number = fn(&TopicCounts) -> Option<u64>;
        let numbers: [(&str, Number); 5] = [
            ("received", |topic| Some(topic.received)),
            ("lost upstream", |topic| topic.lost),
            ("without a free slot", |topic| Some(topic.no_slot)),
            ("larger than `max_size`", |topic| Some(topic.too_big)),
            ("malformed", |topic| topic.malformed),
        ];
        if a.as_ref().map(|a| &a.topic) != b.as_ref().map(|b| &b.topic) {
            let name =
                |topic: &Option<TopicCounts>| topic.as_ref().map(|topic| topic.topic.clone());
            add(format!("topic of `{input}`"), name(&a), name(&b));
        }
        for (what, number) in numbers {
            let word = |topic: &Option<TopicCounts>| topic.as_ref().and_then(number).map(grouped);
            add(format!("samples of `{input}`, {what}"), word(&a), word(&b));
        }
    }
    changes
}

/// Compares the median costs of a wake. A live run has no `signals.json`: its run time is that of
/// its summary, and its fuel is unknown.
fn cost(a: (&RunSummary, Option<&Signals>), b: (&RunSummary, Option<&Signals>)) -> Vec<Cost> {
    let time = |(summary, signals): (&RunSummary, Option<&Signals>)| match (signals, summary) {
        (Some(signals), _) => Some(signals.run_ns.p50).filter(|_| signals.run_ns.count > 0),
        (None, RunSummary::Live(live)) => run(live),
        (None, RunSummary::Replay(_)) => None,
    };
    let fuel = |(_, signals): (&RunSummary, Option<&Signals>)| {
        signals
            .and_then(|signals| signals.fuel.as_ref())
            .filter(|fuel| fuel.count > 0)
            .map(|fuel| fuel.p50)
    };
    let cost = |what, unit, a: Option<u64>, b: Option<u64>| {
        let ratio = a.zip(b).filter(|(a, _)| *a > 0).map(|(a, b)| b as f64 / a as f64);
        (a.is_some() || b.is_some()).then_some(Cost { what, unit, a, b, ratio })
    };
    let all = [cost("run time", "ns", time(a), time(b)), cost("fuel", "fuel", fuel(a), fuel(b))];
    all.into_iter().flatten().collect()
}

fn run(live: &LiveStatus) -> Option<u64> {
    live.run_time.map(|run| run.p50_ns)
}
