use std::error::Error;
use std::fmt;

use crate::Exit;
use crate::text::visible;

/// An error with help for the user. The error enum of a room implements this beside its messages.
pub trait Explain: Error {
    /// Help for the user, as a lower-case fragment; `None` if there is none.
    fn help(&self) -> Option<String> {
        None
    }

    /// The exit code of a program that fails with this error.
    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// An error as the user sees it: what failed, why, and what to do.
///
/// ```text
/// error: cannot start lambda `brake-dark`
///   cause: topic `/camera/front` is listed twice in lambda.toml, lines 8 and 14
///   help:  keep one [[input]] entry per topic
/// ```
///
/// `main` prints it on standard error and ends with [`Failure::exit`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    pub exit: Exit,
    pub message: String,
    /// The causes, the nearest first.
    pub causes: Vec<String>,
    pub help: Option<String>,
}

impl Failure {
    pub fn new(exit: Exit, message: impl Into<String>) -> Failure {
        Failure { exit, message: message.into(), causes: Vec::new(), help: None }
    }

    /// Creates a failure of `action`, for example ``cannot start lambda `brake-dark` ``, caused by
    /// `error`.
    pub fn because(action: impl Into<String>, error: &dyn Explain) -> Failure {
        Failure { help: error.help(), ..Failure::caused_by(error.exit(), action, error) }
    }

    /// As [`because`](Self::because), for an error that has neither help nor an exit code.
    pub fn caused_by(exit: Exit, action: impl Into<String>, error: &dyn Error) -> Failure {
        let mut failure = Failure::new(exit, action);
        failure.add_cause(error.to_string());
        failure.add_sources(error);
        failure
    }

    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Failure {
        self.help = Some(help.into());
        self
    }

    /// Parses a failure that another Gleaner program printed before it exited with `exit`; `None`
    /// if `text` is not a failure.
    pub fn parse(text: &str, exit: Exit) -> Option<Failure> {
        let mut lines = text.lines();
        let mut failure = Failure::new(exit, lines.next()?.strip_prefix(ERROR)?);
        for line in lines {
            if let Some(cause) = line.strip_prefix(CAUSE) {
                failure.causes.push(cause.to_owned());
            } else if let Some(help) = line.strip_prefix(HELP) {
                failure.help = Some(help.to_owned());
            } else {
                let Failure { message, causes, help, .. } = &mut failure;
                let last = help.as_mut().unwrap_or_else(|| causes.last_mut().unwrap_or(message));
                last.push('\n');
                last.push_str(line.trim_start());
            }
        }
        Some(failure)
    }

    fn add_sources(&mut self, error: &dyn Error) {
        let mut source = error.source();
        while let Some(error) = source {
            self.add_cause(error.to_string());
            source = error.source();
        }
    }

    /// Adds a cause. Many libraries repeat the text of their source at the end of their own: such a
    /// cause is skipped.
    fn add_cause(&mut self, cause: String) {
        let above = self.causes.last().unwrap_or(&self.message);
        if !above.ends_with(cause.trim_end()) {
            self.causes.push(cause);
        }
    }
}

const ERROR: &str = "error: ";
const CAUSE: &str = "  cause: ";
const HELP: &str = "  help:  ";

/// The way out of EAGAIN of `fork` and `clone`, which the policy SCHED_DEADLINE gets, too.
const NO_PROCESS_HELP: &str = "permit more processes (`ulimit -u`, the container's limit); below \
                               `chrt --deadline`, add `--reset-on-fork`";

/// The error's own message becomes the failed action; its sources are the causes.
impl<E: Explain> From<E> for Failure {
    fn from(error: E) -> Failure {
        let mut failure =
            Failure { help: error.help(), ..Failure::new(error.exit(), error.to_string()) };
        failure.add_sources(&error);
        failure
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_labelled(f, ERROR, &self.message)?;
        for cause in &self.causes {
            f.write_str("\n")?;
            write_labelled(f, CAUSE, cause)?;
        }
        let is_eagain = self.causes.iter().any(|cause| cause.ends_with("(os error 11)"));
        if let Some(help) = self.help.as_deref().or(is_eagain.then_some(NO_PROCESS_HELP)) {
            f.write_str("\n")?;
            write_labelled(f, HELP, help)?;
        }
        Ok(())
    }
}

/// Writes `text` after `label`, with its further lines indented below its first. Control
/// characters, which may come from a file or a lambda, are escaped.
fn write_labelled(f: &mut fmt::Formatter<'_>, label: &str, text: &str) -> fmt::Result {
    f.write_str(label)?;
    for (index, line) in text.trim_end().lines().enumerate() {
        if index > 0 {
            write!(f, "\n{:width$}", "", width = label.len())?;
        }
        f.write_str(&visible(line))?;
    }
    Ok(())
}

/// Returns an error with its causes, in one line.
pub fn chain(error: &(dyn Error + 'static)) -> String {
    let causes = std::iter::successors(Some(error), |&error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum StartError {
        #[error("cannot start lambda `{0}`")]
        Manifest(&'static str, #[source] ListedTwice),
        #[error("cannot read `{0}`")]
        Read(&'static str, #[source] io::Error),
        #[error("cannot send: {0}")]
        Send(#[source] io::Error),
    }

    #[derive(Debug, thiserror::Error)]
    #[error("topic `/camera/front` is listed twice in lambda.toml, lines 8 and 14")]
    struct ListedTwice;

    impl Explain for StartError {
        fn help(&self) -> Option<String> {
            matches!(self, StartError::Manifest(..))
                .then(|| "keep one [[input]] entry per topic".to_owned())
        }

        fn exit(&self) -> Exit {
            if matches!(self, StartError::Manifest(..)) { Exit::Usage } else { Exit::Internal }
        }
    }

    #[test]
    fn a_failure_is_printed_with_causes_and_help() {
        let failure = Failure::from(StartError::Manifest("brake-dark", ListedTwice));
        assert_eq!(
            failure.to_string(),
            "error: cannot start lambda `brake-dark`\n  \
               cause: topic `/camera/front` is listed twice in lambda.toml, lines 8 and 14\n  \
               help:  keep one [[input]] entry per topic"
        );
        assert_eq!(failure.exit, Exit::Usage);
    }

    #[test]
    fn an_action_is_printed_above_the_error_that_caused_its_failure() {
        let error = StartError::Read("drive.mcap", io::Error::other("no such device"));
        let failure = Failure::because("cannot replay the drive", &error).with_help("plug it in");
        assert_eq!(
            failure.to_string(),
            "error: cannot replay the drive\n  \
               cause: cannot read `drive.mcap`\n  \
               cause: no such device\n  \
               help:  plug it in"
        );
        assert_eq!(failure.exit, Exit::Internal);
    }

    #[test]
    fn a_cause_that_repeats_the_text_above_it_is_skipped() {
        let failure = Failure::from(StartError::Send(io::Error::other("broken pipe")));
        assert_eq!(failure.to_string(), "error: cannot send: broken pipe");
    }

    #[test]
    fn further_lines_of_a_cause_are_indented_below_its_first() {
        let error = io::Error::other("first\nsecond\n");
        let failure = Failure::caused_by(Exit::Unreachable, "cannot connect", &error);
        assert_eq!(failure.to_string(), "error: cannot connect\n  cause: first\n         second");
    }

    #[test]
    fn a_printed_failure_is_parsed_back() {
        let mut failure = Failure::new(Exit::Denied, "cannot load\nit");
        for _ in 0..2 {
            for help in [None, Some("rm 'x'\nor wait".to_owned())] {
                failure.help = help;
                assert_eq!(
                    Failure::parse(&failure.to_string(), Exit::Denied),
                    Some(failure.clone())
                );
            }
            failure.causes = vec!["one".to_owned(), "two\nof two lines".to_owned()];
        }
        assert_eq!(Failure::parse("warning: error: x", Exit::Denied), None);
        assert_eq!(Failure::parse("", Exit::Denied), None);
    }

    #[test]
    fn control_characters_do_not_reach_the_terminal() {
        let failure = Failure::new(Exit::Internal, "a \u{1b}[2J b");
        assert_eq!(failure.to_string(), "error: a \\u{1b}[2J b");
    }

    #[test]
    fn the_question_mark_converts_an_explained_error_into_a_failure() {
        fn run() -> Result<(), Failure> {
            Err(StartError::Read("x", io::Error::other("gone")))?
        }
        assert_eq!(run().unwrap_err().causes, ["gone"]);
    }
}
