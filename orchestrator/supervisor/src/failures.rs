//! Failed processes of a run. A run with failures does not end with success, even if its last
//! processes do.

use gleaner_base::{Exit, Failure};

#[derive(Default)]
pub(crate) struct Failures {
    reason: Option<String>,
    times: u32,
    /// True if a lambda faulted in one of the processes.
    faulted: bool,
    /// Exit code of the first lambda that could not start.
    not_started: Option<Exit>,
    damaged: bool,
}

impl Failures {
    pub(crate) fn add(&mut self, reason: String, faulted: bool) {
        self.reason = Some(reason);
        self.times += 1;
        self.faulted |= faulted;
    }

    /// Notes whether a lambda faulted in a process that ended because another one failed.
    pub(crate) fn note(&mut self, faulted: bool) {
        self.faulted |= faulted;
    }

    /// Adds a lambda that could not start, and is not started again. It has printed the cause.
    pub(crate) fn add_not_started(&mut self, exit: Exit) {
        self.not_started.get_or_insert(exit);
    }

    /// Notes that the drive ended early, as it is damaged.
    pub(crate) fn drive_is_damaged(&mut self) {
        self.damaged = true;
    }

    /// Returns the result of the run if its last processes ended with `exit`.
    pub(crate) fn end(self, exit: Exit) -> Result<Exit, Failure> {
        if let Some(exit) = self.not_started {
            return Ok(exit);
        }
        if self.damaged {
            return Ok(Exit::DriveDamaged);
        }
        match self.reason {
            _ if exit != Exit::Ok => Ok(exit),
            None => Ok(Exit::Ok),
            Some(_) if self.faulted => Ok(Exit::LambdaFaulted),
            Some(reason) => {
                let times = if self.times == 1 {
                    "once".to_owned()
                } else {
                    format!("{} times", self.times)
                };
                let mut failure = Failure::new(Exit::Internal, format!("a process failed {times}"));
                failure.causes = vec![reason];
                Err(failure.with_help(
                    "the results lack only the time between each failure and its restart",
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the exit code of a run with these failures, true for a fault, and this last exit
    /// code.
    fn end(faults: &[bool], exit: Exit) -> Exit {
        let mut failures = Failures::default();
        faults.iter().for_each(|faulted| failures.add("it ended".to_owned(), *faulted));
        failures.end(exit).unwrap_or_else(|failure| failure.exit)
    }

    #[test]
    fn a_run_with_failures_does_not_end_with_success() {
        assert_eq!(end(&[], Exit::Ok), Exit::Ok);
        assert_eq!(end(&[], Exit::LambdaFaulted), Exit::LambdaFaulted);
        assert_eq!(end(&[false], Exit::Ok), Exit::Internal);
        assert_eq!(end(&[true, false], Exit::Ok), Exit::LambdaFaulted);
        assert_eq!(end(&[false, false], Exit::LambdaFaulted), Exit::LambdaFaulted);
    }

    #[test]
    fn failures_are_counted_and_the_last_one_is_the_cause() {
        let mut failures = Failures::default();
        ["a disk", "a network"]
            .into_iter()
            .for_each(|reason| failures.add(reason.to_owned(), false));
        let failure = failures.end(Exit::Ok).unwrap_err().to_string();
        assert!(
            failure.contains("a process failed 2 times") && failure.contains("a network"),
            "{failure}"
        );
    }

    #[test]
    fn a_damaged_drive_outweighs_faults() {
        let mut failures = Failures::default();
        failures.add("it ended".to_owned(), true);
        failures.drive_is_damaged();
        assert_eq!(failures.end(Exit::LambdaFaulted).unwrap(), Exit::DriveDamaged);
    }

    #[test]
    fn a_lambda_that_could_not_start_decides_the_exit_code() {
        let mut failures = Failures::default();
        failures.add_not_started(Exit::Usage);
        failures.add_not_started(Exit::Denied);
        failures.add("it ended".to_owned(), true);
        assert_eq!(failures.end(Exit::LambdaFaulted).unwrap(), Exit::Usage);
    }
}
