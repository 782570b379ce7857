//! Reads the pipes of a process: reports on standard output, messages on standard error.

use std::io::{self, BufRead, Read};
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_base::{each_piece, visible};

/// Maximum size of a report, far above that of a trigger with all its attributes or of a clip with
/// all its lists.
pub const REPORT_BYTES: u64 = 16 << 20;

/// Reads the next report into `line`; returns false at the end. A line beyond [`REPORT_BYTES`],
/// which a lambda's process could write, comes in pieces that cannot be parsed.
///
/// # Errors
///
/// Errors of reading.
pub fn next_report(reports: &mut impl BufRead, line: &mut Vec<u8>) -> io::Result<bool> {
    line.clear();
    Ok(reports.take(REPORT_BYTES).read_until(b'\n', line)? > 0)
}

/// Passes lines to `show`, and sets `explained` if one of them is an error message.
pub fn pass_on(stderr: impl Read, explained: &AtomicBool, mut show: impl FnMut(&[u8])) {
    each_piece(stderr, |piece| {
        if piece.is_failure() {
            explained.store(true, Ordering::Relaxed);
        }
        show(escaped(piece.bytes).as_bytes());
    });
}

/// Escapes control characters, except tabs and the line end.
fn escaped(piece: &[u8]) -> String {
    let text = String::from_utf8_lossy(piece);
    let (words, end) = text.strip_suffix('\n').map_or((&*text, ""), |words| (words, "\n"));
    words.split('\t').map(visible).collect::<Vec<_>>().join("\t") + end
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_the_runtime_are_passed_on_line_by_line_to_the_end() {
        let long = "x".repeat(10_000);
        let mut shown = Vec::new();
        let text = format!("one\n{long}\nno line end");
        pass_on(text.as_bytes(), &AtomicBool::new(false), |piece| shown.push(piece.to_vec()));
        assert_eq!(shown[0], b"one\n");
        assert_eq!(shown.concat(), text.as_bytes());
        assert!(shown.iter().all(|piece| piece.len() <= 8192));
    }

    #[test]
    fn control_characters_of_messages_are_escaped() {
        for (text, shown) in [
            ("plain\ttext, ä\n", "plain\ttext, ä\n"),
            ("\u{1b}]0;owned\u{7}\n", "\\u{1b}]0;owned\\u{7}\n"),
            ("back\rover", "back\\rover"),
            ("\u{202e}turned", "\\u{202e}turned"),
        ] {
            assert_eq!(escaped(text.as_bytes()), shown);
        }
        assert_eq!(escaped(b"\xffbroken\n"), "\u{fffd}broken\n");
    }

    #[test]
    fn only_a_line_that_begins_with_error_explains_an_exit_code() {
        let inside = format!("{}error: x", "y".repeat(8192));
        for (text, expected) in [
            ("error: x", true),
            ("a\nerror: x\n", true),
            ("an error: x\n", false),
            (&inside, false),
            ("", false),
        ] {
            let explained = AtomicBool::new(false);
            pass_on(text.as_bytes(), &explained, |_| {});
            assert_eq!(explained.into_inner(), expected);
        }
    }
}
