//! What a person sees of a comparison. Text out: nothing is read or printed here.

use std::fmt::{self, Write};

use gleaner_base::visible;

use super::compare::{Is, Of, ratio};
use super::{Change, Cost, Diff, Difference, Side, Tally};
use crate::results::{grouped, three_digits};
use crate::show::{Paint, counted};

/// As many of each kind are shown; the rest is counted.
const SHOWN: usize = 20;

/// The differences, for a person.
pub(super) fn text(diff: &Diff, paint: Paint) -> String {
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
    for (of, thing, tally) in [(Of::Trigger, "trigger", diff.triggers), (Of::Fault, "fault", diff.faults)] {
        for (is, count) in [(Is::Gone, tally.gone), (Is::New, tally.new), (Is::Changed, tally.changed)] {
            let listed = diff.differences.iter().filter(|difference| difference.of == of && difference.is == is);
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
        let line =
            format!("{sign}{:>10.3} s  {}  {}", difference.t, visible(&difference.label), visible(&difference.detail));
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
    format!("{}: {} {} ({}), {drive}", visible(out), visible(lambda), visible(version), kind.as_str())
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

fn cost_in_words(Cost { what, unit, a, b, ratio: by }: &Cost) -> String {
    let word = |value: &Option<u64>| match (value, *unit) {
        (None, _) => "unknown".to_owned(),
        (Some(ns), "ns") => format!("{} µs", three_digits(*ns as f64 / 1e3)),
        (Some(count), _) => grouped(*count),
    };
    let by = by.map(|by| format!(" ({})", ratio(by))).unwrap_or_default();
    format!("{what}, median: {} → {}{by}", word(a), word(b))
}
