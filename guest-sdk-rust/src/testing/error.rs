//! What a test cannot ask of the fake host, in words for its author.

use std::fmt;

/// A manifest, config value, message or lambda that cannot be used: what, why, and the way out. It
/// prints alike with `{}` and `{:?}`, so that `unwrap` shows it as it is.
#[derive(Clone, PartialEq, Eq)]
pub struct Error {
    what: String,
    cause: String,
    help: String,
}

impl Error {
    /// `cause` and `help` may be empty.
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

/// The one of `known` that `word` was most likely meant to be.
pub(super) fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // The distance takes time in proportion to both lengths, and nobody misspells a name with a
    // page of text.
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

/// Letters to insert, take away or change. Source: Wagner and Fischer, The String-to-String
/// Correction Problem, 1974.
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
    fn the_nearest_name_is_found_and_a_far_one_is_not() {
        assert_eq!(distance("kitten", "sitting"), 3);
        assert_eq!(nearest("dept", ["name", "depth", "topic"]), Some("depth"));
        assert_eq!(nearest("camera", ["name", "depth"]), None);
    }

    #[test]
    fn an_error_says_what_why_and_the_way_out_also_in_unwrap() {
        let error = Error::new("cannot do it", "no time", "wait");
        assert_eq!(format!("{error:?}"), "cannot do it\n  cause: no time\n  help:  wait");
        assert_eq!(Error::new("cannot do it", "", "").to_string(), "cannot do it");
    }
}
