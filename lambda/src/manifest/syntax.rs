//! Converts errors of the TOML parser to errors for the user.

use toml::de::Error as TomlError;

use super::error::ManifestError;
use super::table::Document;
use gleaner_base::text::excerpt;

/// Converts an error of the TOML parser to one for the user.
pub(super) fn explain(document: &Document, error: &TomlError) -> ManifestError {
    let end = document.text.len();
    let span = error.span().unwrap_or(end..end);
    let line = document.line(span.start);
    let file = document.file.to_owned();
    let key = document.text.get(span).filter(|_| error.message().starts_with("duplicate key"));
    if let Some(key) = key
        && let Some((what, first)) = earlier(document.text, key, line)
    {
        let help = "keep one of the two";
        return ManifestError::Twice { what, name: excerpt(key), file, first, second: line, help };
    }
    ManifestError::Syntax { file, line, message: excerpt(error.message()) }
}

/// Finds the first line with `key`, which was refused as a duplicate in `line`. The parser does not
/// report it, so the text is searched: for the name of a table, or for a key above in the same
/// table.
fn earlier(text: &str, key: &str, line: usize) -> Option<(&'static str, usize)> {
    let above: Vec<&str> = text.lines().take(line).map(str::trim_start).collect();
    let (second, above) = above.split_last()?;
    let is_table = second.starts_with('[');
    for (index, candidate) in above.iter().enumerate().rev() {
        let name = candidate.trim_start_matches('[').trim_start();
        let after = name.strip_prefix(key).map(str::trim_start);
        match (is_table, candidate.starts_with('[')) {
            (true, true) if after.is_some_and(|after| after.starts_with(']')) => {
                return Some(("table", index + 1));
            }
            (false, false) if after.is_some_and(|after| after.starts_with('=')) => {
                return Some(("key", index + 1));
            }
            (false, true) => return None,
            _ => {}
        }
    }
    None
}
