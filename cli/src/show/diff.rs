//! What a person sees of a comparison.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_report::words::{counted, grouped, three_digits};
use gleaner_report::{Change, Cost, Diff, Difference, Is, Of, Side, Tally};

use super::Paint;

/// As many of each kind are shown; the rest is counted.
const SHOWN: usize = 20;

/// The differences, for a person.
pub(crate) fn diff(diff: &Diff, paint: Paint) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = write(&mut text, diff, paint);
    text
}

fn write(text: &mut String, diff: &Diff, paint: Paint) -> fmt::Result {
    for note in &diff.notes {
        writeln!(text, "{}", paint.yellow(&visible(note)))?;
    }
    for (sign, side) in [("-", &diff.a), ("+", &diff.b)] {
        writeln!(text, "{sign} {}", paint.bold(&named(side)))?;
    }
    for change in &diff.config {
        writeln!(text, "  config {}", in_words(change))?;
    }
    for (thing, tally) in [("trigger", diff.triggers), ("fault", diff.faults)] {
        writeln!(text, "  {}", tally_in_words(thing, tally, paint))?;
    }
    for change in &diff.counts {
        writeln!(text, "  {}", in_words(change))?;
    }
    for cost in &diff.cost {
        writeln!(text, "  {}", cost_in_words(cost))?;
    }
    for (of, thing, tally) in
        [(Of::Trigger, "trigger", diff.triggers), (Of::Fault, "fault", diff.faults)]
    {
        for (is, count) in
            [(Is::Gone, tally.gone), (Is::New, tally.new), (Is::Changed, tally.changed)]
        {
            let listed = diff
                .differences
                .iter()
                .filter(|difference| difference.of == of && difference.is == is);
            block(text, listed, is, &counted(count, thing), count, paint)?;
        }
    }
    Ok(())
}

fn block<'a>(
    text: &mut String,
    listed: impl Iterator<Item = &'a Difference>,
    is: Is,
    title: &str,
    count: u64,
    paint: Paint,
) -> fmt::Result {
    if count == 0 {
        return Ok(());
    }
    let (word, sign) = match is {
        Is::Gone => ("gone", '-'),
        Is::New => ("new", '+'),
        Is::Changed => ("changed", '~'),
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
        let line = match is {
            Is::Gone => paint.red(line),
            Is::New => paint.green(line),
            Is::Changed => paint.yellow(line),
        };
        writeln!(text, "{line}")?;
        shown += 1;
    }
    match count.saturating_sub(shown) {
        0 => Ok(()),
        more => writeln!(text, "{:>13}  and {} more", "", grouped(more)),
    }
}

fn named(side: &Side) -> String {
    let drive: Vec<_> = side.drive.iter().map(|drive| visible(drive)).collect();
    let drive = if drive.is_empty() { "live".to_owned() } else { drive.join(", ") };
    let Side { out, lambda, version, kind, .. } = side;
    format!(
        "{}: {} {} ({}), {drive}",
        visible(out),
        visible(lambda),
        visible(version),
        kind.as_str()
    )
}

fn in_words(Change { what, a, b }: &Change) -> String {
    let word = |value: &Option<String>| value.as_deref().map_or("unknown".to_owned(), visible);
    format!("{}: {} → {}", visible(what), word(a), word(b))
}

fn tally_in_words(thing: &str, tally: Tally, paint: Paint) -> String {
    let Tally { same, gone, new, changed } = tally;
    if tally.is_same() {
        return match same {
            0 => format!("no {thing} in either"),
            same => paint.green(&format!("{} the same", counted(same, thing))),
        };
    }
    let [same, gone, new, changed] = [same, gone, new, changed].map(grouped);
    format!("{thing}s: {same} the same, {gone} gone, {new} new, {changed} changed")
}

fn cost_in_words(Cost { what, unit, a, b, ratio }: &Cost) -> String {
    let word = |value: &Option<u64>| match (value, *unit) {
        (None, _) => "unknown".to_owned(),
        (Some(ns), "ns") => format!("{} µs", three_digits(*ns as f64 / 1e3)),
        (Some(count), _) => grouped(*count),
    };
    let by = ratio.map(|by| format!(" (x{})", three_digits(by))).unwrap_or_default();
    format!("{what}, median: {} → {}{by}", word(a), word(b))
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::manifest::Kind;

    use super::*;

    fn side(out: &str) -> Side {
        let [out, lambda, version] = [out, "hello", "0.1.0"].map(str::to_owned);
        Side {
            out,
            lambda,
            version,
            kind: Kind::Wasm,
            drive: vec!["a.mcap".to_owned()],
            start_ns: Some(0),
        }
    }

    fn alike() -> Diff {
        Diff {
            same: true,
            a: side("a"),
            b: side("b"),
            notes: Vec::new(),
            config: Vec::new(),
            counts: Vec::new(),
            cost: Vec::new(),
            triggers: Tally::default(),
            faults: Tally::default(),
            differences: Vec::new(),
            left_out: 0,
        }
    }

    fn difference(is: Is, t: f64, label: &str) -> Difference {
        let (label, detail) = (label.to_owned(), "1".to_owned());
        Difference { at_ns: (t * 1e9) as i64, t, of: Of::Trigger, is, topic: None, label, detail }
    }

    fn text(changed: &Diff) -> String {
        diff(changed, Paint { on: false })
    }

    #[test]
    fn what_makes_runs_hard_to_compare_is_said_first_and_unknown_is_no_number() {
        let change = |what: &str, a: Option<&str>, b: &str| {
            let [a, b] = [a, Some(b)].map(|value| value.map(str::to_owned));
            Change { what: what.to_owned(), a, b }
        };
        let changed = Diff {
            notes: vec!["different lambdas: `hello` and `brake-dark`".to_owned()],
            config: vec![change("brake", Some("-1.4"), "-2.0")],
            counts: vec![
                change("wakes", Some("400"), "500"),
                change("samples of `imu`, lost", None, "4"),
            ],
            cost: vec![Cost {
                what: "time in the lambda",
                unit: "ns",
                a: Some(2000),
                b: Some(3000),
                ratio: Some(1.5),
            }],
            ..alike()
        };
        let text = text(&changed);
        assert!(text.starts_with("different lambdas"), "{text}");
        for line in [
            "- a: hello 0.1.0 (wasm), a.mcap",
            "  config brake: -1.4 → -2.0",
            "  no trigger in either",
            "  wakes: 400 → 500",
            "  samples of `imu`, lost: unknown → 4",
            "  time in the lambda, median: 2 µs → 3 µs (x1.5)",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}: {text}");
        }
    }

    #[test]
    fn twenty_of_each_kind_are_shown_and_the_others_are_counted() {
        let gone = (0..1000).map(|ms| difference(Is::Gone, f64::from(ms) / 1e3, "gone"));
        let new = (3000..3020).map(|ms| difference(Is::New, f64::from(ms) / 1e3, "new"));
        let text = text(&Diff {
            same: false,
            triggers: Tally { same: 0, gone: 3000, new: 30, changed: 0 },
            differences: gone.chain(new).collect(),
            ..alike()
        });
        assert!(text.contains("  triggers: 0 the same, 3,000 gone, 30 new, 0 changed\n"), "{text}");
        assert!(
            text.contains("and 2,980 more")
                && text.contains("+     3.000 s  new  1\n")
                && text.contains("and 10 more"),
            "{text}"
        );
    }

    #[test]
    fn hostile_texts_do_not_act_on_a_terminal() {
        let differences = vec![difference(Is::Gone, 0.0, "\u{1b}[2J")];
        let text =
            text(&Diff { triggers: Tally { gone: 1, ..Tally::default() }, differences, ..alike() });
        assert!(!text.contains('\u{1b}') && text.contains("\\u{1b}[2J"), "{text}");
    }
}
