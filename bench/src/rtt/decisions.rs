//! Checks that all sides make the same decisions: they do the same arithmetic.

use std::collections::BTreeMap;

use gleaner_bench::{BenchResults, Figure};

use super::note;
use super::sides::Turn;
use super::workload::Workload;

/// Labels of the triggers by the number of the sample.
type Labels<'a> = BTreeMap<u64, &'a str>;

/// Adds the number of decisions that differ from those of the first turn. The sender sends the same
/// samples in each turn. `turns` are named with their side.
pub(super) fn compare<'a>(
    workload: Workload,
    group: &str,
    turns: impl Iterator<Item = (String, &'a Turn)>,
    results: &mut BenchResults,
) {
    let (mut kept, mut left_out) = (Vec::new(), Vec::new());
    for (name, turn) in turns {
        match labels(turn) {
            Some(labels) => kept.push(labels),
            None => left_out.push(name),
        }
    }
    if !left_out.is_empty() {
        let why = "not each sample has an answer, so these turns are not compared";
        note(results, format!("{group}: decisions: {why}: {}.", left_out.join("; ")));
    }
    let [mut compared, mut differing, mut with_trigger] = [0; 3];
    if let Some((expected, others)) = kept.split_first() {
        for (sample, labels) in others.iter().flatten() {
            let Some(expected) = expected.get(sample) else { continue };
            compared += 1;
            differing += u64::from(labels != expected);
            with_trigger += u64::from(!labels.is_empty());
        }
    }
    if compared == 0 {
        let why = "no two turns have an answer to each sample";
        return note(results, format!("{group}: no decisions are compared: {why}."));
    }
    let name = format!(
        "{group}: decisions that differ between sides, of {compared} compared, {with_trigger} with \
         a trigger"
    );
    results.figures.push(Figure::at_most(&name, "samples", 0.0, &[differing as f64]));
    if workload == Workload::ImuSpectrum {
        // Sides that never decide would be equal, too. The road of the drive is rough in parts.
        let name = format!("{group}: decisions with a trigger");
        results.figures.push(Figure::at_least(&name, "samples", 1.0, &[with_trigger as f64]));
    }
}

/// Returns the decisions of a turn. The number of a wake is that of its sample if each sample woke
/// the side; other turns have none.
fn labels(turn: &Turn) -> Option<Labels<'_>> {
    let numbered = turn.answers.iter().map(|answer| Some((answer.wake?, answer.labels.as_str())));
    let labels = numbered.collect::<Option<Labels<'_>>>()?;
    let (last, _) = labels.last_key_value()?;
    (last + 1 == turn.sent).then_some(labels)
}
