//! A model is loaded by a process of its own first, which then ends: a load that kills its process
//! harms no other model, and its cause is certain.

use std::cell::Cell;
use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::InferenceLimits;
use gleaner_protocol::inference::{
    AddClient, InferenceReport, ModelCall, ModelClient, ModelMemory,
};

use super::blame::{ENDS_MAX, refusal};
use super::passed_model::PassedModel;
use super::{InferenceEvent, InferenceService};
use crate::POLL_INTERVAL;
use crate::last_error::LastError;
use crate::restart_delay::RestartDelay;

/// Tries that show nothing about the model, as their process was ended from outside or could not be
/// started. The pauses between them take 13 s: until then, the lambda waits and does not fail.
const UNTRIED_MAX: usize = 8;

pub(super) struct LoadTrial {
    pub(super) program: PathBuf,
    pub(super) limits: InferenceLimits,
    /// A lambda with the only model that it opens.
    pub(super) add: AddClient,
    pub(super) model: PassedModel,
    /// Memory that its load has taken.
    pub(super) memory: Cell<ModelMemory>,
}

impl LoadTrial {
    /// Returns the reason why the load must not happen, if there is one. Other loads wait so long:
    /// all tries together have the time of one load, and those that are ended from outside as much
    /// again. The start of a process does not count.
    ///
    /// # Errors
    ///
    /// The reason why it cannot be tried now.
    pub(super) fn run(&self, stops: impl Fn() -> bool) -> Result<Option<String>, String> {
        let model = &self.model.model;
        let refused = |how: &str, reason: &str| {
            let lambda = &self.add.name;
            let how = format!("{how} while it was loaded for `{lambda}` in a process of its own");
            Ok(Some(refusal(model, &how, reason)))
        };
        let [mut left, mut left_outside] = [self.limits.load_max; 2];
        let (mut faults, mut untried, mut delay) = (0, 0, RestartDelay::of_service());
        while !stops() {
            let mut ready = None;
            let tried = self.once(left, &mut ready, &stops);
            let took = ready.map_or(Duration::ZERO, |ready: Instant| ready.elapsed());
            match tried {
                Ok(None) => return Ok(None),
                Ok(Some(end)) => {
                    (faults, left) = (faults + 1, left.saturating_sub(took));
                    if faults == ENDS_MAX {
                        return refused(&format!("{ENDS_MAX} times"), &end);
                    }
                    if left.is_zero() {
                        return refused("after the longest time that a load may take,", &end);
                    }
                }
                Err(Failure { message, causes, .. }) => {
                    (untried, left_outside) = (untried + 1, left_outside.saturating_sub(took));
                    if untried == UNTRIED_MAX || left_outside.is_zero() {
                        let cause = [&[message], &causes[..]].concat().join(": ");
                        let path = &model.path;
                        return Err(format!(
                            "model `{path}` cannot be tried, {untried} times; at last: {cause}"
                        ));
                    }
                    thread::sleep(delay.after(Duration::ZERO));
                }
            }
        }
        Ok(None)
    }

    /// Returns why the process ended that loads the model, unless it has reported a result. It may
    /// take the time `left` from when it is `ready`.
    fn once(
        &self,
        left: Duration,
        ready: &mut Option<Instant>,
        stops: impl Fn() -> bool,
    ) -> Result<Option<String>, Failure> {
        let (sender, events) = channel();
        let (program, limits) = (self.program.clone(), self.limits);
        let events_of = move |event| drop(sender.send(event));
        let service = InferenceService::launch(program, limits, Vec::new(), events_of)?;
        let socket = service.connect(self.add.clone(), self.model.clone())?;
        let mut client = ModelClient::new(socket);
        let open = ModelCall::Open { model: self.add.models[0].name.clone() };
        // Its report is awaited instead of the reply.
        client.call(open, None, Some(Instant::now()))?;
        let mut error = LastError::default();
        loop {
            match events.recv_timeout(POLL_INTERVAL) {
                Ok(InferenceEvent::Report(InferenceReport::Model(loaded))) => {
                    self.memory.set(loaded.memory);
                    return Ok(None);
                }
                Ok(InferenceEvent::Report(InferenceReport::Ready)) => *ready = Some(Instant::now()),
                Ok(InferenceEvent::Stderr(piece)) => error.add(&piece, ""),
                Ok(InferenceEvent::Ended(end, _, is_fault)) => {
                    let cause = error.in_one_line().map(|cause| format!(": {cause}"));
                    let end = end + &cause.unwrap_or_default();
                    // One that was ended from outside shows nothing about the model.
                    let ended = |end| Failure::new(Exit::Internal, end);
                    return if is_fault { Ok(Some(end)) } else { Err(ended(end)) };
                }
                Err(RecvTimeoutError::Disconnected) => return Ok(Some("it ended".to_owned())),
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
            }
            if stops() {
                return Ok(None);
            }
            if ready.is_some_and(|ready| ready.elapsed() >= left) {
                // It may not end on request. Without a thread, it is dropped here.
                let _ = thread::Builder::new().spawn(move || drop(service));
                let seconds = self.limits.load_max.as_secs_f64();
                return Ok(Some(format!(
                    "it was not loaded and run once in {seconds} s, which is `load_max` in \
                     [inference] of the vehicle; for TensorRT, build its engine ahead: gleaner \
                     check DIR --build-engines"
                )));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::process::Command;
    use std::sync::Arc;

    use gleaner_protocol::inference::{LoadedModel, ModelEngine, ModelFile};

    use super::*;

    /// Returns the result of a trial whose process is a shell that runs `lines`.
    fn tried(lines: &str, load_max: Duration) -> Result<Option<String>, String> {
        let folder = tempfile::tempdir().unwrap();
        let [text, program] = ["text", "program"].map(|name| folder.path().join(name));
        fs::write(&text, format!("#!/bin/sh\ncd \"${{0%/*}}\"\n{lines}\n")).unwrap();
        // By another process: a child of another test may have inherited a file open for writing.
        let install = Command::new("install").args([&text, &program]).status();
        assert!(install.unwrap().success());
        let add = r#"{"id": "", "name": "", "memory": 0, "models":
            [{"name": "m", "sha256": "", "providers": []}]}"#;
        let add: AddClient = serde_json::from_str(add).unwrap();
        let (path, engine) = ("m.onnx".to_owned(), ModelEngine::None);
        let model = ModelFile { sha256: String::new(), path, engine };
        let file = Arc::new(tempfile::tempfile().unwrap());
        let limits = InferenceLimits { load_max, ..InferenceLimits::default() };
        let model = PassedModel { model, file, engine: None };
        let memory = Cell::default();
        LoadTrial { program, limits, add, model, memory }.run(|| false)
    }

    #[test]
    fn a_trial_that_is_killed_or_stands_still_is_tried_again_and_its_start_may_take_long() {
        let report = InferenceReport::Model(LoadedModel::default());
        let [starting, report] =
            [InferenceReport::Starting, report].map(|it| serde_json::json!(it));
        let lines = format!(
            "mkdir 1 2>/dev/null && kill -9 $$\n\
             mkdir 2 2>/dev/null && exec sleep 600\n\
             mkdir 3 2>/dev/null || exit 3\n\
             echo '{starting}'; sleep 16; echo '{report}'"
        );
        // The second has sent no report when it stands still. The third is not ready for 16 s.
        assert_eq!(tried(&lines, Duration::from_secs(1)), Ok(None));
    }

    #[test]
    fn all_tries_of_a_load_together_have_the_time_of_one() {
        let second = Duration::from_secs(1);
        let ready = serde_json::json!(InferenceReport::Ready);
        let lines = format!("echo '{ready}'; mkdir 1 2>/dev/null && exit 3\nexec sleep 30");
        let refusal = tried(&lines, second).unwrap().unwrap();
        assert!(refusal.contains("after the longest time that a load may take"), "{refusal}");
        let cause = tried("kill -9 $$", second).unwrap_err();
        let begin = "model `m.onnx` cannot be tried, 8 times; at last: ";
        assert!(cause.starts_with(begin) && cause.contains("signal: 9"), "{cause}");
    }
}
