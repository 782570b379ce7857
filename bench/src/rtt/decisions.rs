//! Checks that all sides make the same decisions: they do the same arithmetic.

use std::collections::BTreeMap;

use gleaner_bench::Figure;

use super::sides::Turn;

/// Labels of the triggers by the number of the sample.
type Labels<'a> = BTreeMap<u64, &'a str>;

/// Returns the decisions that differ from those of the first turn; `None` if there are no two turns
/// to compare. The sender sends the same samples in each turn.
pub(super) fn differing<'a>(group: &str, turns: impl Iterator<Item = &'a Turn>) -> Option<Figure> {
    let mut turns = turns.filter_map(labels);
    let expected = turns.next()?;
    let (mut compared, mut differing) = (0, 0);
    for turn in turns {
        for (sample, labels) in &turn {
            let Some(expected) = expected.get(sample) else { continue };
            compared += 1;
            differing += u64::from(labels != expected);
        }
    }
    let name = format!("{group}: decisions that differ between sides, of {compared} compared");
    (compared > 0).then(|| Figure::at_most(&name, "samples", 0.0, &[differing as f64]))
}

/// Returns the decisions of a turn. The number of a wake is that of its sample if each sample woke
/// the side; other turns have none.
fn labels(turn: &Turn) -> Option<Labels<'_>> {
    let numbered = turn.answers.iter().map(|answer| Some((answer.wake?, answer.labels.as_str())));
    let labels = numbered.collect::<Option<Labels<'_>>>()?;
    let (last, _) = labels.last_key_value()?;
    (last + 1 == turn.sent).then_some(labels)
}
