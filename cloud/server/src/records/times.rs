//! The order of records of several streams by their times.

use std::collections::HashMap;

use serde::Deserialize;

/// The parts of a line that its place among others depends on.
#[derive(Debug, Default, Deserialize)]
struct TimedLine {
    stream: String,
    time_ns: i64,
}

/// Returns the time of a record, in ns since 1970, if it has one.
pub(crate) fn time_ns(line: &str) -> Option<i64> {
    let line: TimedLine = serde_json::from_str(line).ok()?;
    Some(line.time_ns).filter(|time| *time != 0)
}

/// Orders lines by their times. Those of a stream stay in their order, which is the true one: its
/// clock may have been set back, and a gap has no time.
pub(crate) fn in_time_order<L: AsRef<str>>(lines: impl IntoIterator<Item = L>) -> Vec<L> {
    let (mut latest, mut before) = (HashMap::new(), 0);
    let mut timed: Vec<(i64, L)> = lines
        .into_iter()
        .map(|line| {
            let parsed = serde_json::from_str::<TimedLine>(line.as_ref()).unwrap_or_default();
            let time: &mut i64 = latest.entry(parsed.stream).or_default();
            // Without a time, and with none before it in its stream, it stays where it arrived.
            *time =
                if (parsed.time_ns, *time) == (0, 0) { before } else { parsed.time_ns.max(*time) };
            before = *time;
            (before, line)
        })
        .collect();
    timed.sort_by_key(|(time, _)| *time);
    timed.into_iter().map(|(_, line)| line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_several_streams_are_in_the_order_of_their_times() {
        let line =
            |(stream, time): (&str, i64)| format!("{{\"stream\":\"{stream}\",\"time_ns\":{time}}}");
        // One without a time, and one of a clock that was set back, stay behind those before them.
        let arrived =
            [("a", 5), ("a", 9), ("a", 0), ("b", 4), ("b", 7), ("c", 0), ("b", 6), ("b", 8)];
        let expected =
            [("b", 4), ("a", 5), ("b", 7), ("c", 0), ("b", 6), ("b", 8), ("a", 9), ("a", 0)];
        assert_eq!(in_time_order(arrived.map(line)), expected.map(line));
        assert_eq!((time_ns(&line(("a", 5))), time_ns(&line(("a", 0)))), (Some(5), None));
    }
}
