//! Formats a comparison of two runs.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_report::format::{counted, grouped, three_digits};
use gleaner_report::{
    ChangeCounts, ChangeKind, ComparedRun, Cost, Diff, Difference, DifferenceKind, ValueChange,
};

use super::{Paint, written};

/// Maximum number of shown differences of each kind and change; the others are counted.
const SHOWN: usize = 20;

pub(crate) fn diff(diff: &Diff, paint: Paint) -> String {
    written(|text| write(text, diff, paint))
}

fn write(text: &mut String, diff: &Diff, paint: Paint) -> fmt::Result {
    for note in &diff.notes {
        writeln!(text, "{}", paint.yellow(&visible(note)))?;
    }
    for (sign, side) in [("-", &diff.a), ("+", &diff.b)] {
        writeln!(text, "{sign} {}", paint.bold(&named(side)))?;
    }
    for change in &diff.config {
        writeln!(text, "  config {}", value_change(change))?;
    }
    for (thing, counts) in [("trigger", diff.triggers), ("fault", diff.faults)] {
        writeln!(text, "  {}", change_counts(thing, counts, paint))?;
    }
    for change in &diff.counts {
        writeln!(text, "  {}", value_change(change))?;
    }
    for cost in &diff.cost {
        writeln!(text, "  {}", cost_change(cost))?;
    }
    for (kind, thing, counts) in [
        (DifferenceKind::Trigger, "trigger", diff.triggers),
        (DifferenceKind::Fault, "fault", diff.faults),
    ] {
        for (change, count) in [
            (ChangeKind::Removed, counts.removed),
            (ChangeKind::Added, counts.added),
            (ChangeKind::Changed, counts.changed),
        ] {
            let listed = diff
                .differences
                .iter()
                .filter(|difference| difference.kind == kind && difference.change == change);
            block(text, listed, change, &counted(count, thing), count, paint)?;
        }
    }
    Ok(())
}

fn block<'a>(
    text: &mut String,
    listed: impl Iterator<Item = &'a Difference>,
    change: ChangeKind,
    title: &str,
    count: u64,
    paint: Paint,
) -> fmt::Result {
    if count == 0 {
        return Ok(());
    }
    let (word, sign) = match change {
        ChangeKind::Removed => ("removed", '-'),
        ChangeKind::Added => ("added", '+'),
        ChangeKind::Changed => ("changed", '~'),
    };
    writeln!(text, "{}", paint.bold(&format!("{title} {word}")))?;
    let mut shown = 0;
    for difference in listed.take(SHOWN) {
        let line = format!(
            "{sign}{:>10.3} s  {}  {}",
            difference.t,
            visible(&difference.label),
            visible(&difference.detail)
        );
        let line = line.trim_end();
        let line = match change {
            ChangeKind::Removed => paint.red(line),
            ChangeKind::Added => paint.green(line),
            ChangeKind::Changed => paint.yellow(line),
        };
        writeln!(text, "{line}")?;
        shown += 1;
    }
    match count.saturating_sub(shown) {
        0 => Ok(()),
        more => writeln!(text, "{:>13}  and {} more", "", grouped(more)),
    }
}

fn named(side: &ComparedRun) -> String {
    let drive: Vec<_> = side.drive.iter().map(|drive| visible(drive)).collect();
    let drive = if drive.is_empty() { "live".to_owned() } else { drive.join(", ") };
    let ComparedRun { out, lambda, version, kind, .. } = side;
    format!(
        "{}: {} {} ({}), {drive}",
        visible(out),
        visible(lambda),
        visible(version),
        kind.as_str()
    )
}

fn value_change(ValueChange { what, a, b }: &ValueChange) -> String {
    let word = |value: &Option<String>| value.as_deref().map_or("unknown".to_owned(), visible);
    format!("{}: {} → {}", visible(what), word(a), word(b))
}

fn change_counts(thing: &str, counts: ChangeCounts, paint: Paint) -> String {
    let ChangeCounts { identical, removed, added, changed } = counts;
    if counts.is_identical() {
        return match identical {
            0 => format!("no {thing}s in either"),
            count => paint.green(&format!("{} identical", counted(count, thing))),
        };
    }
    let [identical, removed, added, changed] = [identical, removed, added, changed].map(grouped);
    format!("{thing}s: {identical} identical, {removed} removed, {added} added, {changed} changed")
}

fn cost_change(Cost { what, unit, a, b, ratio }: &Cost) -> String {
    let word = |value: &Option<u64>| match (value, *unit) {
        (None, _) => "unknown".to_owned(),
        (Some(ns), "ns") => format!("{} µs", three_digits(*ns as f64 / 1e3)),
        (Some(count), _) => grouped(*count),
    };
    let by = ratio.map(|by| format!(" (x{})", three_digits(by))).unwrap_or_default();
    format!("{what}, p50: {} → {}{by}", word(a), word(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(out: &str) -> ComparedRun {
        let [out, lambda, version] = [out, "hello", "0.1.0"].map(str::to_owned);
        ComparedRun {
            out,
            lambda,
            version,
            drive: vec!["a.mcap".to_owned()],
            start_ns: Some(0),
            ..ComparedRun::default()
        }
    }

    fn empty_diff() -> Diff {
        Diff { identical: true, a: side("a"), b: side("b"), ..Diff::default() }
    }

    fn difference(change: ChangeKind, t: f64, label: &str) -> Difference {
        let (label, detail) = (label.to_owned(), "1".to_owned());
        Difference {
            at_ns: (t * 1e9) as i64,
            t,
            kind: DifferenceKind::Trigger,
            change,
            topic: None,
            label,
            detail,
        }
    }

    fn text(changed: &Diff) -> String {
        diff(changed, Paint { on: false })
    }

    #[test]
    fn notes_come_first_and_unknown_values_are_no_numbers() {
        let change = |what: &str, a: Option<&str>, b: &str| {
            let [a, b] = [a, Some(b)].map(|value| value.map(str::to_owned));
            ValueChange { what: what.to_owned(), a, b }
        };
        let changed = Diff {
            notes: vec!["different lambdas: `hello` and `brake-dark`".to_owned()],
            config: vec![change("brake", Some("-1.4"), "-2.0")],
            counts: vec![
                change("wakes", Some("400"), "500"),
                change("samples of `imu`, lost upstream", None, "4"),
            ],
            cost: vec![Cost {
                what: "run time",
                unit: "ns",
                a: Some(2000),
                b: Some(3000),
                ratio: Some(1.5),
            }],
            ..empty_diff()
        };
        let text = text(&changed);
        assert!(text.starts_with("different lambdas"), "{text}");
        for line in [
            "- a: hello 0.1.0 (wasm), a.mcap",
            "  config brake: -1.4 → -2.0",
            "  no triggers in either",
            "  wakes: 400 → 500",
            "  samples of `imu`, lost upstream: unknown → 4",
            "  run time, p50: 2 µs → 3 µs (x1.5)",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}: {text}");
        }
    }

    #[test]
    fn twenty_of_each_kind_are_shown_and_the_others_are_counted() {
        let removed =
            (0..1000).map(|ms| difference(ChangeKind::Removed, f64::from(ms) / 1e3, "removed"));
        let added =
            (3000..3020).map(|ms| difference(ChangeKind::Added, f64::from(ms) / 1e3, "added"));
        let text = text(&Diff {
            identical: false,
            triggers: ChangeCounts { identical: 0, removed: 3000, added: 30, changed: 0 },
            differences: removed.chain(added).collect(),
            ..empty_diff()
        });
        assert!(
            text.contains("  triggers: 0 identical, 3,000 removed, 30 added, 0 changed\n"),
            "{text}"
        );
        assert!(
            text.contains("and 2,980 more")
                && text.contains("+     3.000 s  added  1\n")
                && text.contains("and 10 more"),
            "{text}"
        );
    }

    #[test]
    fn control_characters_are_escaped() {
        let differences = vec![difference(ChangeKind::Removed, 0.0, "\u{1b}[2J")];
        let text = text(&Diff {
            triggers: ChangeCounts { removed: 1, ..ChangeCounts::default() },
            differences,
            ..empty_diff()
        });
        assert!(!text.contains('\u{1b}') && text.contains("\\u{1b}[2J"), "{text}");
    }
}
