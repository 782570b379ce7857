//! The reason of an end that was not requested: the last message that the process has written to
//! standard error explains it.

use std::process::ExitStatus;

use gleaner_base::in_one_line;

/// Maximum length of a message that is kept, in bytes. A traceback ends with what counts.
const MAX: usize = 8192;

/// The last error message of a process, and its last line.
#[derive(Debug, Default)]
pub(crate) struct LastError {
    /// From `error: ` on; empty without one.
    message: String,
    line: String,
}

impl LastError {
    /// Adds a piece of standard error that begins with `prefix`.
    pub(crate) fn add(&mut self, text: &[u8], prefix: &str) {
        let text = String::from_utf8_lossy(text);
        let text = text.strip_prefix(prefix).unwrap_or(&text).trim_end();
        if text.starts_with("error: ") {
            text.clone_into(&mut self.message);
        } else if text.trim_start().starts_with("help: ") && text.contains("--out ") {
            // An option of a command line, which the reader of a reason has not typed.
        } else if self.message.is_empty() {
            self.line = text.chars().take(MAX).collect();
        } else if self.message.len() < MAX {
            self.message = format!("{}\n{text}", self.message);
        }
    }

    /// Returns the error message, without its label.
    pub(crate) fn message(&self) -> Option<&str> {
        self.message.strip_prefix("error: ")
    }

    /// Returns the error message, or else the last line, in one line.
    pub(crate) fn in_one_line(&self) -> Option<String> {
        let text = in_one_line(self.message().unwrap_or(&self.line));
        (!text.is_empty()).then_some(text)
    }
}

/// Returns the text for a process that ended without a request.
pub(crate) fn unexpected_end(process: &str, status: ExitStatus) -> String {
    format!("{process} ended unexpectedly ({status})")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(lines: &[&str]) -> Option<String> {
        let mut error = LastError::default();
        lines.iter().for_each(|line| error.add(line.as_bytes(), "a: "));
        error.in_one_line()
    }

    #[test]
    fn an_error_message_counts_and_else_the_last_line() {
        assert_eq!(after(&[]), None);
        assert_eq!(after(&["one\n", "a: two\n"]).unwrap(), "two");
        let message = ["a: error: cannot open `x`\n", "a:   cause: the disk is full\n"];
        let expected = "cannot open `x`; cause: the disk is full";
        let help = "a:   help:  choose another folder: --out DIR\n";
        assert_eq!(after(&[&["before\n"], &message[..], &[help]].concat()).unwrap(), expected);
        let long = "x".repeat(10_000);
        assert!(after(&[&long]).unwrap().len() <= MAX);
    }
}
