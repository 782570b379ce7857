//! Formats text for messages: lists of words, the nearest match of a misspelt word, numbers, and
//! untrusted text made safe to print.

use std::fmt::Display;
use std::path::Path;

pub use gleaner_rules::text::visible;

/// Returns the one of `known` that is most similar to `word`, if any is.
pub fn nearest<'k>(word: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    // The time grows with the product of both lengths, and a longer word is no misspelling.
    if word.len() > 64 {
        return None;
    }
    let allowed = (word.chars().count() / 3).max(1);
    known
        .into_iter()
        .map(|candidate| (strsim::damerau_levenshtein(word, candidate), candidate))
        .filter(|(distance, _)| *distance <= allowed)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Returns " (did you mean `x`?)", or nothing, for the end of an error message.
pub fn hint(nearest: &Option<String>) -> String {
    nearest.as_ref().map(|name| format!(" (did you mean `{name}`?)")).unwrap_or_default()
}

/// Formats a list: `` `a` ``, `` `a` and `b` ``, `` `a`, `b` and `c` ``. `last` is `and` or `or`.
pub fn list<W: AsRef<str>>(text: &[W], last: &str) -> String {
    let quoted: Vec<String> = text.iter().map(|word| format!("`{}`", word.as_ref())).collect();
    match quoted.split_last() {
        Some((end, rest)) if !rest.is_empty() => format!("{} {last} {end}", rest.join(", ")),
        _ => quoted.concat(),
    }
}

/// Shortens untrusted text for a message and escapes its control characters.
pub fn excerpt(text: &str) -> String {
    const SHOWN: usize = 80;
    match text.char_indices().nth(SHOWN) {
        Some((end, _)) => visible(&text[..end]) + "…",
        None => visible(text),
    }
}

/// Formats a failed action and its causes in one line, safe to print.
pub fn describe(action: &str, causes: &[String]) -> String {
    let parts = std::iter::once(action).chain(causes.iter().map(String::as_str));
    parts.map(visible).collect::<Vec<_>>().join(": ")
}

/// Formats a text of several lines as one, safe to print. Of a Python traceback, the last line
/// counts: the type and the message of the exception.
pub fn in_one_line(text: &str) -> String {
    let mut parts: Vec<String> = Vec::new();
    // The text before a traceback, while its lines follow.
    let mut traced: Option<&str> = None;
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
        // The next part of a failure.
        if line.starts_with("cause: ") || line.starts_with("help: ") {
            traced = None;
        }
        if let Some(before) = traced {
            parts.pop();
            parts.push(format!("{before}{line}"));
        } else if let Some((before, _)) = line.split_once("Traceback (most recent call last)") {
            traced = Some(before);
            parts.push(line.to_owned());
        } else {
            parts.push(line.to_owned());
        }
    }
    visible(&parts.join("; "))
}

/// Returns `path` as one word of a shell command, quoted where necessary.
pub fn shell_word(path: &Path) -> String {
    let text = path.to_string_lossy();
    let plain = |character: char| character.is_alphanumeric() || "/._-+=:,@%".contains(character);
    match !text.is_empty() && text.chars().all(plain) {
        true => text.into_owned(),
        false => format!("'{}'", text.replace('\'', r"'\''")),
    }
}

/// Returns `bytes` as lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Formats a whole number with commas between thousands.
pub fn grouped(count: impl Display) -> String {
    let digits = count.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_traceback_in_one_line_is_the_last_exception() {
        assert_eq!(in_one_line("one"), "one");
        assert_eq!(in_one_line("error: a\n  cause: b\u{1b}\n\n"), "error: a; cause: b\\u{1b}");
        let text = "cannot start `a`\n  cause: in init: Traceback (most recent call last):\n\
                    \u{20}          File \"main.py\", line 5\n         ValueError: no\n\n\
                    \u{20}        Traceback (most recent call last):\n           File \"main.py\"\n\
                    \u{20}        KeyError: 'x'\n  help:  repair it";
        let expected = "cannot start `a`; cause: in init: KeyError: 'x'; help:  repair it";
        assert_eq!(in_one_line(text), expected);
    }

    #[test]
    fn the_nearest_word_is_returned_only_if_it_is_similar() {
        let known = ["event", "period", "backlog"];
        assert_eq!(nearest("evnt", known), Some("event"));
        assert_eq!(nearest("peroid", known), Some("period"));
        assert_eq!(nearest("colour", known), None);
        assert_eq!(nearest("", known), None);
        assert_eq!(nearest(&"event".repeat(100), known), None);
    }

    #[test]
    fn lists_end_with_their_last_word() {
        assert_eq!(list::<&str>(&[], "and"), "");
        assert_eq!(list(&["a"], "and"), "`a`");
        assert_eq!(list(&["a", "b"], "or"), "`a` or `b`");
        assert_eq!(list(&["a", "b", "c"], "and"), "`a`, `b` and `c`");
    }

    #[test]
    fn a_path_with_special_characters_is_quoted_for_a_shell() {
        for (path, word) in [
            ("examples/hello/rust-2", "examples/hello/rust-2"),
            ("föhr/a", "föhr/a"),
            ("my lambda", "'my lambda'"),
            ("it's", r"'it'\''s'"),
            ("a;b", "'a;b'"),
            ("~", "'~'"),
            ("", "''"),
        ] {
            assert_eq!(shell_word(Path::new(path)), word);
        }
    }

    #[test]
    fn an_excerpt_is_cut_and_has_no_control_characters() {
        assert_eq!(excerpt("plain"), "plain");
        assert_eq!(excerpt("\u{1b}[2J\n"), "\\u{1b}[2J\\n");
        assert_eq!(excerpt(&"ä".repeat(81)), format!("{}…", "ä".repeat(80)));
    }
}
