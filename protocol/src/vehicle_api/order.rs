//! The order of lines of several streams that are shown together.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::StreamLine;

/// The parts of a line that its place among others depends on.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct LinePlace {
    stream: String,
    boot: String,
    boot_ns: u64,
    /// Time of the record, in ns since 1970; 0 without one.
    pub time_ns: i64,
}

impl LinePlace {
    /// Reads the place of a line from its JSON.
    pub fn of_json(line: &str) -> Self {
        serde_json::from_str(line).unwrap_or_default()
    }
}

impl From<&StreamLine> for LinePlace {
    fn from(line: &StreamLine) -> Self {
        let StreamLine { stream, boot, boot_ns, time_ns, .. } = line;
        let (stream, boot) = (stream.clone(), boot.clone());
        Self { stream, boot, boot_ns: *boot_ns, time_ns: *time_ns }
    }
}

/// Orders lines of several streams by the boots of the machine, and by the time since each.
///
/// The lines of a stream stay in their order, also if the clock was set back meanwhile. A line
/// without a boot, such as a gap, stays behind the record before it in its stream; at the begin, it
/// is where the record after it is.
pub fn in_order<L>(lines: impl IntoIterator<Item = L>, place: impl Fn(&L) -> LinePlace) -> Vec<L> {
    let mut streams: Vec<Vec<(LinePlace, L)>> = Vec::new();
    let mut known = BTreeMap::new();
    for line in lines {
        let place = place(&line);
        let index = *known.entry(place.stream.clone()).or_insert(streams.len());
        if index == streams.len() {
            streams.push(Vec::new());
        }
        streams[index].push((place, line));
    }
    streams.iter_mut().for_each(|stream| fill(stream));
    let boots = boots(&streams);
    let place = |place: &LinePlace| (boots.iter().position(|it| *it == place.boot), place.boot_ns);
    let mut streams: Vec<_> = streams
        .into_iter()
        .map(|lines| lines.into_iter().map(|(it, line)| (place(&it), line)).peekable())
        .collect();
    let mut ordered = Vec::new();
    loop {
        let firsts = streams.iter_mut().enumerate();
        let firsts = firsts.filter_map(|(index, stream)| Some((stream.peek()?.0, index)));
        let Some((_, index)) = firsts.min() else { return ordered };
        ordered.extend(streams[index].next().map(|(_, line)| line));
    }
}

/// Gives lines of a stream that have no boot their places.
fn fill<L>(stream: &mut [(LinePlace, L)]) {
    let first = stream.iter().find(|(it, _)| !it.boot.is_empty()).map(|(it, _)| it.clone());
    let Some(mut last) = first else { return };
    for (place, _) in stream {
        match place.boot.is_empty() {
            true => place.clone_from(&last),
            false => last.clone_from(place),
        }
    }
}

/// Returns the boots of all streams in their order. Those of which no stream has two are ordered by
/// the time of day.
fn boots<L>(streams: &[Vec<(LinePlace, L)>]) -> Vec<String> {
    let mut boots: Vec<(String, i64)> = Vec::new();
    for stream in streams {
        let mut next = 0;
        for (place, _) in stream {
            if let Some(at) = boots.iter().position(|(it, _)| *it == place.boot) {
                next = at + 1;
                continue;
            }
            let is_before = |(other, at): &&(String, i64)| {
                *at <= place.time_ns && !stream.iter().any(|(own, _)| own.boot == *other)
            };
            next += boots[next..].iter().take_while(is_before).count();
            boots.insert(next, (place.boot.clone(), place.time_ns));
            next += 1;
        }
    }
    boots.into_iter().map(|(boot, _)| boot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Orders lines, each a stream, a boot, the time since it, and the time of day.
    fn order(lines: &[(&'static str, &'static str, u64, i64)]) -> Vec<String> {
        let numbered = lines.iter().enumerate().map(|(number, it)| (number, *it));
        let ordered = in_order(numbered, |(_, (stream, boot, boot_ns, time_ns))| LinePlace {
            stream: (*stream).to_owned(),
            boot: (*boot).to_owned(),
            boot_ns: *boot_ns,
            time_ns: *time_ns,
        });
        ordered.into_iter().map(|(number, (stream, ..))| format!("{stream}{number}")).collect()
    }

    #[test]
    fn streams_are_merged_by_boot_and_time_and_gaps_stay_in_their_place() {
        let gap = |stream| (stream, "", 0, 0);
        let events = [gap("e"), ("e", "a", 10, 0), ("e", "a", 30, 0), gap("e"), ("e", "b", 5, 0)];
        let orchestrator = [("o", "a", 20, 0), ("o", "b", 1, 0), ("o", "b", 6, 0), gap("o")];
        let lines = [&events[..], &orchestrator, &[("e", "c", 7, 0)]].concat();
        assert_eq!(order(&lines), ["e0", "e1", "o5", "e2", "e3", "o6", "e4", "o7", "o8", "e9"]);
        // Of one stream, the clock was set back.
        let set_back = [("e", "a", 5, 90), ("e", "a", 4, 10), ("o", "a", 5, 50)];
        assert_eq!(order(&set_back), ["e0", "e1", "o2"]);
    }

    #[test]
    fn a_boot_that_only_one_stream_has_is_at_its_time_of_day() {
        let both = [("e", "b", 5, 10), ("o", "c", 5, 20)];
        assert_eq!(order(&both), ["e0", "o1"]);
        let later = [("e", "c", 5, 20), ("o", "", 0, 0), ("o", "b", 5, 10)];
        assert_eq!(order(&later), ["o1", "o2", "e0"]);
        let between = [("e", "a", 1, 10), ("e", "c", 1, 30), ("o", "b", 1, 20), ("o", "c", 2, 31)];
        assert_eq!(order(&between), ["e0", "o2", "e1", "o3"]);
    }
}
