use std::error::Error;
use std::fmt;

use crate::Exit;
use crate::text::visible;

/// An error that knows the way out of it. The error enum of a room implements this next to its
/// messages.
pub trait Explain: Error {
    /// What the user can do about it, as a lower-case fragment; `None` if there is nothing but the
    /// cause.
    fn help(&self) -> Option<String> {
        None
    }

    /// How a program ends that meets this error and cannot go on.
    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// How a user sees an error: what failed, why, and what to do.
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
    /// How the program ends.
    pub exit: Exit,
    /// What could not be done.
    pub message: String,
    /// Why, from the nearest cause to the first one.
    pub causes: Vec<String>,
    /// The way out.
    pub help: Option<String>,
}

impl Failure {
    /// A failure without a deeper cause.
    pub fn new(exit: Exit, message: impl Into<String>) -> Failure {
        Failure { exit, message: message.into(), causes: Vec::new(), help: None }
    }

    /// `action`, for example ``cannot start lambda `brake-dark` ``, failed because of `error`.
    pub fn because(action: impl Into<String>, error: &dyn Explain) -> Failure {
        Failure { help: error.help(), ..Failure::caused_by(error.exit(), action, error) }
    }

    /// As [`because`](Self::because), for an error from elsewhere that knows neither a way out nor
    /// an exit code.
    pub fn caused_by(exit: Exit, action: impl Into<String>, error: &dyn Error) -> Failure {
        let mut failure = Failure::new(exit, action);
        failure.add_cause(error.to_string());
        failure.add_sources(error);
        failure
    }

    /// The same failure with this way out.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Failure {
        self.help = Some(help.into());
        self
    }

    /// Reads what another program of ours printed as a failure, and ended with `exit`; `None` if
    /// `text` is none.
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

    /// Many libraries repeat the text of their source at the end of their own: said once is enough.
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

/// The error's own message is what failed; its sources are the causes.
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
        if let Some(help) = &self.help {
            f.write_str("\n")?;
            write_labelled(f, HELP, help)?;
        }
        Ok(())
    }
}

/// `text` behind `label`, with further lines of it below its first. Control characters, which a
/// file or a lambda may have put there, are shown and not sent to the terminal.
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
        Manifest(&'static str, #[source] Twice),
        #[error("cannot read `{0}`")]
        Read(&'static str, #[source] io::Error),
        #[error("cannot talk: {0}")]
        Talk(#[source] io::Error),
    }

    #[derive(Debug, thiserror::Error)]
    #[error("topic `/camera/front` is listed twice in lambda.toml, lines 8 and 14")]
    struct Twice;

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
    fn a_user_sees_what_failed_why_and_the_way_out() {
        let failure = Failure::from(StartError::Manifest("brake-dark", Twice));
        assert_eq!(
            failure.to_string(),
            "error: cannot start lambda `brake-dark`\n  \
               cause: topic `/camera/front` is listed twice in lambda.toml, lines 8 and 14\n  \
               help:  keep one [[input]] entry per topic"
        );
        assert_eq!(failure.exit, Exit::Usage);
    }

    #[test]
    fn an_action_stands_above_the_error_that_prevented_it() {
        let error = StartError::Read("drive.mcap", io::Error::other("no such device"));
        let failure = Failure::because("cannot replay the drive", &error).with_help("plug it in");
        assert_eq!(
            failure.to_string(),
            "error: cannot replay the drive\n  cause: cannot read `drive.mcap`\n  cause: no such device\n  help:  plug it in"
        );
        assert_eq!(failure.exit, Exit::Internal);
    }

    #[test]
    fn a_cause_whose_text_was_just_said_is_skipped() {
        let failure = Failure::from(StartError::Talk(io::Error::other("broken pipe")));
        assert_eq!(failure.to_string(), "error: cannot talk: broken pipe");
    }

    #[test]
    fn further_lines_of_a_cause_stand_below_its_first() {
        let error = io::Error::other("first\nsecond\n");
        let failure = Failure::caused_by(Exit::Unreachable, "cannot connect", &error);
        assert_eq!(failure.to_string(), "error: cannot connect\n  cause: first\n         second");
    }

    #[test]
    fn what_was_printed_reads_back() {
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
    fn an_explained_error_becomes_a_failure_by_the_question_mark() {
        fn run() -> Result<(), Failure> {
            Err(StartError::Read("x", io::Error::other("gone")))?
        }
        assert_eq!(run().unwrap_err().causes, ["gone"]);
    }
}
