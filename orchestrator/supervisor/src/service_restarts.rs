//! The restarts of a process that all lambdas share: when, and why.

use std::process::ExitStatus;
use std::time::{Duration, Instant};

use gleaner_base::Failure;

use crate::last_error::{LastError, unexpected_end};
use crate::output::PIPES;
use crate::restart_delay::{ServiceDelays, was_killed};

/// One process, and the number of those before it.
#[derive(Debug)]
pub(crate) struct ServiceRestarts {
    /// Number of earlier processes.
    pub(crate) start: u32,
    pub(crate) open_pipes: u8,
    /// Set when it has reported that it is ready, until its end.
    pub(crate) is_ready: bool,
    started: Instant,
    delays: ServiceDelays,
    /// Time at which the next one is to be started, as this one has ended.
    again_at: Option<Instant>,
    requested: Option<RequestedEnd>,
    reported: Instant,
    error: LastError,
}

#[derive(Debug)]
struct RequestedEnd {
    reason: String,
    /// True if the process has failed, false if another one is to have other settings.
    has_failed: bool,
}

impl ServiceRestarts {
    pub(crate) fn first() -> Self {
        Self::with(0, ServiceDelays::new())
    }

    pub(crate) fn next(&self) -> Self {
        Self::with(self.start + 1, self.delays.clone())
    }

    fn with(start: u32, delays: ServiceDelays) -> Self {
        let now = Instant::now();
        Self {
            start,
            open_pipes: PIPES,
            is_ready: false,
            started: now,
            delays,
            again_at: None,
            requested: None,
            reported: now,
            error: LastError::default(),
        }
    }

    /// Returns whether it runs, and was not requested to end.
    pub(crate) fn is_running(&self) -> bool {
        self.again_at.is_none() && self.requested.is_none()
    }

    /// Returns whether it has ended, and the end was handled.
    pub(crate) fn has_ended(&self) -> bool {
        self.again_at.is_some()
    }

    pub(crate) fn is_due(&self) -> bool {
        self.again_at.is_some_and(|at| Instant::now() >= at)
    }

    pub(crate) fn reports(&mut self) {
        self.reported = Instant::now();
    }

    /// Keeps what it writes to standard error.
    pub(crate) fn has_written(&mut self, text: &[u8]) {
        self.error.add(text, "");
    }

    pub(crate) fn is_silent(&self, most: Duration) -> bool {
        self.reported.elapsed() > most
    }

    /// Notes that it is requested to end, or killed, as it has failed. The first reason counts.
    pub(crate) fn fails(&mut self, reason: String) {
        self.requested.get_or_insert(RequestedEnd { reason, has_failed: true });
    }

    /// Notes that it is requested to end, as another one is to have other settings. The first
    /// reason counts.
    pub(crate) fn is_replaced(&mut self, reason: String) {
        self.requested.get_or_insert(RequestedEnd { reason, has_failed: false });
    }

    pub(crate) fn reason(&self, name: &str, status: ExitStatus) -> String {
        match (&self.requested, self.error.in_one_line()) {
            (Some(requested), _) => requested.reason.clone(),
            (None, Some(cause)) if !was_killed(status) => {
                format!("{}: {cause}", unexpected_end(name, status))
            }
            (None, _) => unexpected_end(name, status),
        }
    }

    /// Notes its end: another one is to be started after the returned delay, which is zero if it
    /// was replaced.
    pub(crate) fn ended(&mut self, status: ExitStatus) -> Duration {
        let ran = self.started.elapsed();
        let delay = match &self.requested {
            Some(requested) if !requested.has_failed => Duration::ZERO,
            Some(_) => self.delays.after(ran, false),
            None => self.delays.after(ran, was_killed(status)),
        };
        self.restart_after(delay)
    }

    /// Notes that it could not be started; returns the reason, and the delay before another
    /// attempt.
    pub(crate) fn not_started(&mut self, failure: &Failure) -> (String, Duration) {
        let texts = std::iter::once(&failure.message).chain(&failure.causes);
        let texts: Vec<_> = texts.map(|text| text.lines().collect::<Vec<_>>().join(" ")).collect();
        let delay = self.delays.after(Duration::ZERO, false);
        (texts.join(": "), self.restart_after(delay))
    }

    fn restart_after(&mut self, delay: Duration) -> Duration {
        self.is_ready = false;
        self.again_at = Some(Instant::now() + delay);
        delay
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;

    use gleaner_base::Exit;

    use super::*;

    #[test]
    fn an_end_is_explained_by_the_request_or_by_the_last_message() {
        let (failed, killed) = (ExitStatus::from_raw(1 << 8), ExitStatus::from_raw(9));
        let mut restarts = ServiceRestarts::first();
        restarts.has_written(b"error: cannot lock the folder\n");
        restarts.has_written(b"  cause: the disk is full\n");
        let reason = restarts.reason("the recorder", failed);
        let expected = "the recorder ended unexpectedly (exit status: 1): cannot lock the folder; \
                        cause: the disk is full";
        assert_eq!(reason, expected);
        let reason = restarts.reason("the recorder", killed);
        assert_eq!(reason, "the recorder ended unexpectedly (signal: 9 (SIGKILL))");
        restarts.is_replaced("it needs more".to_owned());
        restarts.fails("it is silent".to_owned());
        assert_eq!(restarts.reason("the recorder", failed), "it needs more");
    }

    #[test]
    fn a_process_that_was_replaced_is_followed_at_once() {
        let mut restarts = ServiceRestarts::first();
        restarts.is_replaced("it needs more".to_owned());
        assert_eq!(restarts.ended(ExitStatus::from_raw(0)), Duration::ZERO);
        assert!(restarts.is_due());
    }

    #[test]
    fn faults_of_its_own_are_retried_more_and_more_rarely_and_kills_soon() {
        let [failed, killed] = [1 << 8, 9].map(ExitStatus::from_raw);
        let mut restarts = ServiceRestarts::first();
        let mut last = |status| {
            let mut delay = Duration::ZERO;
            for _ in 0..10 {
                restarts = restarts.next();
                delay = restarts.ended(status);
            }
            assert!(restarts.has_ended() && !restarts.is_running());
            delay.as_secs()
        };
        assert!((24..=30).contains(&last(failed)));
        assert_eq!(last(killed), 1);
        assert_eq!(restarts.start, 20);
    }

    #[test]
    fn a_start_that_failed_is_explained_in_one_line() {
        let mut failure = Failure::new(Exit::Internal, "cannot find x; searched in\n/a\n/b");
        failure.causes = vec!["it is gone".to_owned()];
        let (reason, _) = ServiceRestarts::first().not_started(&failure);
        assert_eq!(reason, "cannot find x; searched in /a /b: it is gone");
    }
}
