//! The error of the fake host, for an invalid input of a test.

use std::fmt;

/// A manifest, config value, message or lambda that cannot be used. The message names the object,
/// the cause and the way out. `{}` and `{:?}` print the same text, so `unwrap` shows it.
#[derive(Clone, PartialEq, Eq)]
pub struct Error {
    what: String,
    cause: String,
    help: String,
}

impl Error {
    /// Creates an error; `cause` and `help` may be empty.
    pub(super) fn new(
        what: impl Into<String>,
        cause: impl Into<String>,
        help: impl Into<String>,
    ) -> Self {
        Self { what: what.into(), cause: cause.into(), help: help.into() }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)?;
        for (title, text) in [("cause: ", &self.cause), ("help:  ", &self.help)] {
            if !text.is_empty() {
                write!(f, "\n  {title}{text}")?;
            }
        }
        Ok(())
    }
}

impl fmt::Debug for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl std::error::Error for Error {}

/// Returns the name in `known` that is most similar to `word`, if one is similar enough.
pub(super) fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // The distance takes time in proportion to both lengths, and no misspelt name is a page long.
    if word.len() > 64 {
        return None;
    }
    let allowed = (word.chars().count() / 3).max(1);
    let known = known.into_iter().filter(|candidate| candidate.len() <= 128);
    let distances = known.map(|candidate| (distance(word, candidate), candidate));
    let near = distances
        .filter(|(distance, _)| *distance <= allowed)
        .min_by_key(|(distance, _)| *distance);
    near.map(|(_, candidate)| candidate)
}

/// Returns the number of letters to insert, remove or change. Source: Wagner and Fischer, The
/// String-to-String Correction Problem, 1974.
fn distance(from: &str, to: &str) -> usize {
    let to = to.chars().collect::<Vec<_>>();
    let mut row = (0..=to.len()).collect::<Vec<_>>();
    for (i, a) in from.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, b) in to.iter().enumerate() {
            let changed = diagonal + usize::from(a != *b);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[to.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_similar_name_is_found_and_a_different_one_is_not() {
        assert_eq!(distance("kitten", "sitting"), 3);
        assert_eq!(nearest("dept", ["name", "depth", "topic"]), Some("depth"));
        assert_eq!(nearest("camera", ["name", "depth"]), None);
    }

    #[test]
    fn an_error_prints_object_cause_and_help_also_in_unwrap() {
        let error = Error::new("cannot do it", "no time", "wait");
        assert_eq!(format!("{error:?}"), "cannot do it\n  cause: no time\n  help:  wait");
        assert_eq!(Error::new("cannot do it", "", "").to_string(), "cannot do it");
    }
}
