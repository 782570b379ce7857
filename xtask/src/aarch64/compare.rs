//! Compares two replays of one lambda bit for bit: decisions, log, and thumbnails of clips.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};
use serde_json::{Map, Value};

use crate::steps::cannot;

/// The results of a replay, and its duration, which is not compared.
pub(super) struct ReplayResults {
    /// One decision for each wake, without its run time.
    pub(super) decisions: Vec<Map<String, Value>>,
    pub(super) seconds: f64,
    /// Contents of the other files that have to be equal, by path in the folder.
    files: BTreeMap<PathBuf, Vec<u8>>,
}

/// Reads the results in `folder` of a replay that had `wakes` wakes and took `seconds`.
pub(super) fn read(folder: &Path, wakes: u64, seconds: f64) -> Result<ReplayResults, Failure> {
    let path = folder.join("decisions.jsonl");
    let text = fs::read_to_string(&path).map_err(|error| cannot("read", &path, &error))?;
    let decisions = text
        .lines()
        .map(parse_decision)
        .collect::<Result<Vec<_>, _>>()
        .map_err(|error| cannot("read", &path, &error))?;
    if decisions.len() as u64 != wakes {
        let message =
            format!("`{}` has {} decisions for {wakes} wakes", path.display(), decisions.len());
        return Err(Failure::new(Exit::Internal, message));
    }
    let files = other_files(folder).map_err(|error| cannot("read", folder, &error))?;
    Ok(ReplayResults { decisions, seconds, files })
}

/// Parses a line of `decisions.jsonl`, without the run time.
fn parse_decision(line: &str) -> Result<Map<String, Value>, serde_json::Error> {
    let mut decision: Map<String, Value> = serde_json::from_str(line)?;
    decision.remove("run_ns");
    Ok(decision)
}

/// Reads the log and the thumbnails.
fn other_files(folder: &Path) -> io::Result<BTreeMap<PathBuf, Vec<u8>>> {
    let mut files =
        BTreeMap::from([(PathBuf::from("log.jsonl"), fs::read(folder.join("log.jsonl"))?)]);
    let clips = folder.join("clips");
    if clips.is_dir() {
        for entry in fs::read_dir(clips)? {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "jpg") {
                files.insert(
                    path.strip_prefix(folder).unwrap_or(&path).to_owned(),
                    fs::read(&path)?,
                );
            }
        }
    }
    Ok(files)
}

/// Formats the numbers of wakes, triggers and faults, and the used fuel.
pub(super) fn counts(decisions: &[Map<String, Value>]) -> String {
    let triggers = decisions
        .iter()
        .filter_map(|decision| decision["triggers"].as_array())
        .map(Vec::len)
        .sum::<usize>();
    let faults = decisions.iter().filter(|decision| !decision["fault"].is_null()).count();
    let fuel = decisions.iter().filter_map(|decision| decision["fuel"].as_u64()).sum::<u64>();
    format!("{} wakes, {triggers} triggers, {faults} faults, {fuel} fuel", decisions.len())
}

/// Returns the first difference, as text; `None` if the results are equal.
pub(super) fn difference(a: &ReplayResults, b: &ReplayResults) -> Option<String> {
    let pairs = a.decisions.iter().zip(&b.decisions).enumerate();
    let decision =
        |(index, (a, b))| Some(format!("decision {}: {}", index + 1, key_that_differs(a, b)?));
    let number = || {
        let (a, b) = (a.decisions.len(), b.decisions.len());
        (a != b).then(|| format!("the number of decisions: {a} and {b}"))
    };
    pairs
        .into_iter()
        .find_map(decision)
        .or_else(number)
        .or_else(|| file_that_differs(&a.files, &b.files))
}

/// Returns the first key with different values. Their texts are compared, so that a signed zero or
/// the last bit of a number makes a difference.
fn key_that_differs(a: &Map<String, Value>, b: &Map<String, Value>) -> Option<String> {
    let written = |of: &Map<String, Value>, key: &str| {
        of.get(key).map_or("nothing".to_owned(), Value::to_string)
    };
    let mut keys = a.keys().chain(b.keys());
    let key = keys.find(|key| written(a, key) != written(b, key))?;
    Some(format!("{key} is {} and {}", written(a, key), written(b, key)))
}

fn file_that_differs(
    a: &BTreeMap<PathBuf, Vec<u8>>,
    b: &BTreeMap<PathBuf, Vec<u8>>,
) -> Option<String> {
    let mut names = a.keys().chain(b.keys());
    let name = names.find(|name| a.get(*name) != b.get(*name))?;
    Some(format!("`{}`", name.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn replayed(lines: &[&str], thumbnail: &[u8]) -> ReplayResults {
        let decisions = lines.iter().map(|line| parse_decision(line).unwrap()).collect();
        let files = BTreeMap::from([(PathBuf::from("clips/1.jpg"), thumbnail.to_vec())]);
        ReplayResults { decisions, seconds: 0.0, files }
    }

    #[test]
    fn run_times_are_not_compared() {
        let [a, b] = [r#"{"at_ns":1,"fuel":7,"run_ns":5}"#, r#"{"at_ns":1,"fuel":7,"run_ns":50}"#];
        assert_eq!(difference(&replayed(&[a], b"x"), &replayed(&[b], b"x")), None);
    }

    #[test]
    fn the_first_difference_is_named() {
        let of =
            |score: &str| format!(r#"{{"at_ns":1,"triggers":[{{"score":{score}}}],"fuel":7}}"#);
        let found = |a: &str, b: &str| {
            let same = of("1.0");
            difference(&replayed(&[&same, &of(a)], b""), &replayed(&[&same, &of(b)], b""))
        };
        assert_eq!(found("0.1", "0.1"), None);
        // The last bit, and the sign of a zero.
        for (a, b) in [("0.3", "0.30000000000000004"), ("0.0", "-0.0")] {
            let expected =
                format!(r#"decision 2: triggers is [{{"score":{a}}}] and [{{"score":{b}}}]"#);
            assert_eq!(found(a, b), Some(expected));
        }
        let [one, none] = [replayed(&["{}"], b""), replayed(&[], b"")];
        assert_eq!(difference(&one, &none).unwrap(), "the number of decisions: 1 and 0");
        let missing = difference(&replayed(&[r#"{"fuel":1}"#], b""), &one).unwrap();
        assert_eq!(missing, "decision 1: fuel is 1 and nothing");
        let pixels = difference(&replayed(&[], b"a"), &replayed(&[], b"b")).unwrap();
        assert_eq!(pixels, "`clips/1.jpg`");
    }
}
