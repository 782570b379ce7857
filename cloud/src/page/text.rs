//! Texts and numbers as the page shows them. Texts come from vehicles and lambdas: their control
//! characters are shown, never sent, and their length is bounded.

use std::fmt::Write as _;

use form_urlencoded::Serializer;
use gleaner_base::{UtcTime, visible};
use maud::{Markup, html};

use crate::store::now;

/// Maximum number of characters of a text, and of lines of one that keeps them.
const SHOWN_MAX: usize = 300;
const BLOCK_MAX: usize = 4000;
const LINES_MAX: usize = 40;

/// Returns a text in one line, without control characters.
pub(super) fn shown(text: &str) -> String {
    visible(&cut(text, SHOWN_MAX))
}

/// Returns a text of several lines, such as a traceback, without other control characters.
pub(super) fn block(text: &str) -> String {
    let text = cut(text, BLOCK_MAX);
    let mut lines: Vec<String> = text.lines().take(LINES_MAX + 1).map(visible).collect();
    if lines.len() > LINES_MAX {
        lines[LINES_MAX] = "…".to_owned();
    }
    lines.join("\n")
}

fn cut(text: &str, most: usize) -> String {
    match text.char_indices().nth(most) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

/// Returns a part of a path: all but plain letters, digits and `._-` are escaped.
pub(super) fn segment(text: &str) -> String {
    let mut escaped = String::new();
    for byte in text.bytes() {
        match byte.is_ascii_alphanumeric() || b"._-".contains(&byte) {
            true => escaped.push(char::from(byte)),
            false => write!(escaped, "%{byte:02X}").expect("a String takes any text"),
        }
    }
    escaped
}

/// Returns the query of an address, without values that are empty.
pub(super) fn query(values: &[(&str, &str)]) -> String {
    let values = values.iter().filter(|(_, value)| !value.is_empty());
    match Serializer::new(String::new()).extend_pairs(values).finish() {
        query if query.is_empty() => query,
        query => format!("?{query}"),
    }
}

/// Returns a score. Lambdas choose its scale: extreme ones are shown with an exponent.
pub(super) fn score(score: f64) -> String {
    match score.abs() {
        0.0 => "0.000".to_owned(),
        0.001..1e6 => format!("{score:.3}"),
        _ => format!("{score:.3e}"),
    }
}

pub(super) fn vehicle_path(name: &str) -> String {
    format!("/vehicles/{}", segment(name))
}

pub(super) fn deployment_path(id: &str) -> String {
    format!("/deployments/{}", segment(id))
}

/// Renders a label as a link to all vehicles that have it.
pub(super) fn label((name, value): (&String, &String)) -> Markup {
    let text = format!("{name}={value}");
    let address = format!("/vehicles{}", query(&[("label", &text)]));
    html! { a.label href=(address) { (shown(&text)) } " " }
}

/// Returns an element with a time in UTC, in s since 1970.
pub(super) fn time(seconds: impl TryInto<i64>) -> Markup {
    // The end of year 9999: later ones have no such form.
    const LAST: i64 = 253_402_300_799;
    let text = UtcTime::of(seconds.try_into().unwrap_or(LAST).min(LAST)).to_string();
    let (day, rest) = text.split_once('T').unwrap_or_default();
    // On a narrow screen, a line may end between these only.
    let of_day = rest.replace('Z', " UTC");
    html! { time datetime=(text) { span { (day) } " " span { (of_day) } } }
}

/// Returns an element with a time in UTC, in ns since 1970.
pub(super) fn moment(ns: i64) -> Markup {
    time(ns.div_euclid(1_000_000_000))
}

/// Returns an element with a time of day with ms, in ns since 1970, and the date as its title; a
/// dash without a time.
pub(super) fn time_of_day(ns: i64) -> Markup {
    if ns == 0 {
        return html! { span.time { "–" } };
    }
    let text = UtcTime::of(ns.div_euclid(1_000_000_000)).to_string();
    let ms = ns.div_euclid(1_000_000).rem_euclid(1000);
    let (day, rest) = text.split_once('T').unwrap_or_default();
    let readable = format!("{}.{ms:03}", rest.trim_end_matches('Z'));
    html! { time.time datetime=(text) { span.day { (day) } " " (readable) } }
}

/// Returns the time since a moment, in s since 1970.
pub(super) fn ago(seconds: u64) -> String {
    let passed = now().saturating_sub(i64::try_from(seconds).unwrap_or(i64::MAX)).max(0);
    format!("{} ago", span(passed as f64))
}

/// Returns a duration in its largest unit.
pub(super) fn span(seconds: f64) -> String {
    match seconds {
        s if s < 60.0 => format!("{s:.0} s"),
        s if s < 3600.0 => format!("{:.0} min", (s / 60.0).floor()),
        s if s < 172_800.0 => format!("{:.0} h", (s / 3600.0).floor()),
        s => format!("{:.0} days", (s / 86_400.0).floor()),
    }
}

/// Returns a duration in ns with three digits.
pub(super) fn duration(ns: u64) -> String {
    let ns = ns as f64;
    let (value, unit) = match ns {
        n if n < 1e3 => (n, "ns"),
        n if n < 1e6 => (n / 1e3, "µs"),
        n if n < 1e9 => (n / 1e6, "ms"),
        n => (n / 1e9, "s"),
    };
    format!("{} {unit}", three_digits(value))
}

pub(super) fn bytes(bytes: f64) -> String {
    let (mut value, mut unit) = (bytes, "B");
    for next in ["KiB", "MiB", "GiB", "TiB"] {
        if value.abs() < 1024.0 {
            break;
        }
        (value, unit) = (value / 1024.0, next);
    }
    format!("{} {unit}", three_digits(value))
}

pub(super) fn amount(value: f64, unit: &str) -> String {
    match unit {
        "B" => bytes(value),
        unit => format!("{} {}", three_digits(value), shown(unit)),
    }
}

fn three_digits(value: f64) -> String {
    match value.abs() {
        v if v == v.trunc() && v < 1000.0 => format!("{value:.0}"),
        v if v < 10.0 => format!("{value:.2}"),
        v if v < 100.0 => format!("{value:.1}"),
        _ => format!("{value:.0}"),
    }
}

pub(super) fn short(digest: &str) -> String {
    digest.chars().filter(char::is_ascii_alphanumeric).take(12).collect()
}

/// Returns a number with its noun, in the plural unless it is 1.
pub(super) fn count(number: u64, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{} {noun}{plural}", gleaner_base::grouped(number))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_shown_and_long_texts_are_cut() {
        assert_eq!(shown("a\u{1b}[2J\u{202e}b"), "a\\u{1b}[2J\\u{202e}b");
        assert_eq!(block("a\r\n\tb\0"), "a\n\\tb\\u{0}");
        assert_eq!(shown(&"x".repeat(1000)).chars().count(), SHOWN_MAX + 1);
        assert_eq!(block(&"x\n".repeat(1000)).lines().count(), LINES_MAX + 1);
    }

    #[test]
    fn a_score_of_any_size_is_short() {
        for (value, expected) in [
            (0.9123, "0.912"),
            (-12.5, "-12.500"),
            (0.0, "0.000"),
            (1e308, "1.000e308"),
            (-1e7, "-1.000e7"),
            (5e-324, "4.941e-324"),
        ] {
            assert_eq!(score(value), expected);
        }
    }

    #[test]
    fn parts_of_addresses_are_escaped() {
        assert_eq!(segment("../a b?\"<é"), "..%2Fa%20b%3F%22%3C%C3%A9");
        assert_eq!(query(&[("label", "a=b&c"), ("state", "")]), "?label=a%3Db%26c");
        assert_eq!(query(&[("state", "")]), "");
    }

    #[test]
    fn numbers_have_units() {
        assert_eq!(["1.50 ms", "12.3 µs", "999 ns"], [1_500_000, 12_345, 999].map(duration));
        assert_eq!(bytes(3.0 * 1024.0 * 1024.0), "3 MiB");
        assert_eq!([span(59.0), span(61.0), span(7200.0)], ["59 s", "1 min", "2 h"]);
        assert_eq!([count(1, "line"), count(2000, "line")], ["1 line", "2,000 lines"]);
    }
}
