//! Formats results as text, for the terminal, the report page and `expected.txt`.

use gleaner_base::visible;
use gleaner_lambda::{Clip, Decision, FaultKind, Trigger};

pub use gleaner_base::grouped;

/// Returns a line of `expected.txt` for each trigger of `decision`:
/// `<seconds %.3f> <label> <score %.3g>`; no score is `-`.
///
/// `start_ns` is [`ReplaySummary::start_ns`](gleaner_protocol::ReplaySummary::start_ns): seconds
/// count from the first message of the drive on any topic.
pub fn trigger_lines(decision: &Decision, start_ns: i64) -> impl Iterator<Item = String> {
    let seconds = seconds(decision.at_ns, start_ns);
    decision
        .triggers
        .iter()
        .map(move |trigger| format!("{seconds:.3} {} {}", visible(&trigger.label), score(trigger)))
}

/// Formats the score of `trigger` in three significant digits, `-` if it has none.
pub fn score(trigger: &Trigger) -> String {
    trigger.score.map_or("-".to_owned(), three_digits)
}

/// Formats `bytes` with a unit: `205 KiB`, `1.3 MiB`.
pub fn size(bytes: u64) -> String {
    match bytes {
        0..1024 => format!("{bytes} B"),
        1024..1_048_576 => format!("{} KiB", bytes.div_ceil(1024)),
        1_048_576..1_073_741_824 => format!("{:.1} MiB", bytes as f64 / 1_048_576.0),
        _ => format!("{:.1} GiB", bytes as f64 / 1_073_741_824.0),
    }
}

/// Formats the contents of a clip: `9.1 s, 205 KiB: messages /imu/data 950, /vehicle/speed 757`.
pub fn clip_contents(clip: &Clip) -> String {
    let [from, to] = clip_span(clip);
    let topics = clip
        .topics
        .iter()
        .map(|topic| format!("{} {}", visible(&topic.topic), grouped(topic.messages)));
    format!(
        "{:.1} s, {}: messages {}",
        seconds(to, from),
        size(clip.bytes),
        topics.collect::<Vec<_>>().join(", ")
    )
}

/// Returns the log times of a clip's first and last message; of its window, if it has no messages.
pub fn clip_span(clip: &Clip) -> [i64; 2] {
    [clip.first_ns.unwrap_or(clip.from_ns), clip.last_ns.unwrap_or(clip.to_ns)]
}

/// Converts log time `at_ns` to s after `start_ns`.
pub fn seconds(at_ns: i64, start_ns: i64) -> f64 {
    at_ns.saturating_sub(start_ns) as f64 / 1e9
}

/// Formats `value` like C's `printf("%.3g")`: three significant digits without trailing zeros, in
/// scientific notation from 1000 on and below 0.0001.
///
/// Source: ISO C, `fprintf`, conversion `g`: with precision P and exponent X it is `%f` if P > X >=
/// -4, else `%e`.
pub fn three_digits(value: f64) -> String {
    if !value.is_finite() {
        return value.to_string().to_lowercase();
    }
    // Rounding may carry into the next power of ten, so the exponent is read from the rounded
    // value.
    let scientific = format!("{value:.2e}");
    let (digits, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trimmed = |text: &str| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text.to_owned(),
    };
    match exponent {
        -4..=2 => trimmed(&format!("{value:.*}", (2 - exponent) as usize)),
        _ => format!(
            "{}e{}{:02}",
            trimmed(digits),
            if exponent < 0 { '-' } else { '+' },
            exponent.abs()
        ),
    }
}

/// Formats a count with its noun: `1 wake`, `2,000 wakes`.
pub fn counted(count: u64, thing: &str) -> String {
    format!("{} {thing}{}", grouped(count), if count == 1 { "" } else { "s" })
}

/// Returns the name of `kind` in `decisions.jsonl`.
pub fn fault_kind(kind: FaultKind) -> String {
    let word = serde_json::to_value(kind).ok();
    word.as_ref().and_then(|word| word.as_str()).unwrap_or("fault").to_owned()
}

/// Returns the most informative line of a fault's message: the first, or the last of a Python
/// traceback.
pub fn gist(message: &str) -> &str {
    let mut lines = message.lines().map(str::trim).filter(|line| !line.is_empty());
    let traceback = message.contains("Traceback (most recent call last)");
    let line = if traceback { lines.next_back() } else { lines.next() };
    line.unwrap_or_default()
}

/// Returns `message` with each number as `#`, except for places in code (`lib.rs:17:9`, `line 3`).
/// Faults that are equal then have one cause.
pub fn without_numbers(message: &str) -> String {
    let (mut key, mut previous) = (Vec::new(), "");
    for word in message.split_inclusive(char::is_whitespace) {
        let is_place = word.contains(".rs:") || previous == "line ";
        let hides = |letter: char| letter.is_ascii_digit() && !is_place;
        key.extend(word.chars().map(|letter| if hides(letter) { '#' } else { letter }));
        previous = word;
    }
    key.dedup_by(|a, b| (*a, *b) == ('#', '#'));
    key.into_iter().collect()
}

/// Cuts `text` to `chars` characters and marks the cut with `…`.
pub(crate) fn cut(text: &str, chars: usize) -> String {
    match text.char_indices().nth(chars) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_match_printf() {
        // Right column: `printf '%.3g'` of a C library.
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "-0"),
            (1.0, "1"),
            (1.5, "1.5"),
            (1.456, "1.46"),
            (-1.456, "-1.46"),
            (1.125, "1.12"),
            (1.375, "1.38"),
            (0.1, "0.1"),
            (9.996, "10"),
            (99.96, "100"),
            (999.4, "999"),
            (999.6, "1e+03"),
            (1234.0, "1.23e+03"),
            (0.000123456, "0.000123"),
            (0.00009999, "0.0001"),
            (0.0000999, "9.99e-05"),
            (0.00001, "1e-05"),
            (1e100, "1e+100"),
            (5e-324, "4.94e-324"),
            (f64::NAN, "nan"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
        ] {
            assert_eq!(three_digits(value), text, "of {value:?}");
        }
    }

    #[test]
    fn a_size_has_a_suitable_unit() {
        let sizes = [0, 1023, 1024, 1025, 205_089, 1_048_576, 10_000_000, 3 << 30].map(size);
        let shown = ["0 B", "1023 B", "1 KiB", "2 KiB", "201 KiB", "1.0 MiB", "9.5 MiB", "3.0 GiB"];
        assert_eq!(sizes, shown);
    }

    #[test]
    fn thousands_are_grouped() {
        for (count, text) in [
            (0, "0"),
            (999, "999"),
            (1000, "1,000"),
            (123_456, "123,456"),
            (1_234_567, "1,234,567"),
        ] {
            assert_eq!(grouped(count), text);
        }
    }

    #[test]
    fn a_trigger_is_a_line_with_its_time_after_the_start() {
        let decision: Decision = serde_json::from_str(concat!(
            r#"{"at_ns":1700000010810000000,"cause":"event","input":"imu","topic":"/imu","writer":null,"seq":1,"#,
            r#""triggers":[{"kind":"event","label":"hard-brake","score":1.456,"attributes":{}},"#,
            r#"{"kind":"stop","label":"a\u001b[2J","score":null,"attributes":{}}],"fault":null,"fuel":1,"run_ns":2}"#
        ))
        .unwrap();
        let lines: Vec<_> = trigger_lines(&decision, 1_700_000_000_000_000_000).collect();
        assert_eq!(lines, ["10.810 hard-brake 1.46", "10.810 a\\u{1b}[2J -"]);
    }

    #[test]
    fn times_at_the_ends_of_the_range_do_not_overflow() {
        assert!(seconds(i64::MIN, i64::MAX) < 0.0);
        assert_eq!(seconds(1_500_000_000, 0), 1.5);
    }
}
