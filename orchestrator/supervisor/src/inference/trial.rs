//! A model is loaded by a process of its own first, which then ends: a load that kills its process
//! harms no other model, and its cause is certain.

use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::InferenceLimits;
use gleaner_protocol::inference::{AddClient, InferenceReport, ModelCall, ModelClient};

use super::blame::{ENDS_MAX, refusal};
use super::passed_model::PassedModel;
use super::{InferenceEvent, InferenceService};
use crate::last_error::LastError;

const POLL_INTERVAL: Duration = Duration::from_millis(100);

pub(super) struct LoadTrial {
    pub(super) program: PathBuf,
    pub(super) limits: InferenceLimits,
    /// A lambda with the only model that it opens.
    pub(super) add: AddClient,
    pub(super) model: PassedModel,
}

impl LoadTrial {
    /// Returns the reason why the load must not happen, if there is one.
    ///
    /// # Errors
    ///
    /// The reason why it cannot be tried now.
    pub(super) fn run(&self, stops: impl Fn() -> bool) -> Result<Option<String>, String> {
        let model = &self.model.model;
        let ended = |how: &str, reason: &str| {
            let lambda = &self.add.name;
            let how = format!("{how} while it was loaded for `{lambda}` in a process of its own");
            Ok(Some(refusal(model, &how, reason)))
        };
        let mut reason = String::new();
        for _ in 0..ENDS_MAX {
            let begin = Instant::now();
            match self.once(&stops) {
                Ok(None) => return Ok(None),
                // Other loads wait meanwhile.
                Ok(Some(end)) if begin.elapsed() >= self.limits.load_max => {
                    return ended("after the longest time that a load may take,", &end);
                }
                Ok(Some(end)) => reason = end,
                Err(Failure { message, causes, .. }) => {
                    let why = [&[message], &causes[..]].concat().join(": ");
                    return Err(format!("model `{}` cannot be tried now: {why}", model.path));
                }
            }
        }
        ended(&format!("{ENDS_MAX} times"), &reason)
    }

    /// Returns why the process ended that loads the model, unless it has reported a result.
    fn once(&self, stops: impl Fn() -> bool) -> Result<Option<String>, Failure> {
        let (sender, events) = channel();
        let (program, limits) = (self.program.clone(), self.limits);
        let events_of = move |event| drop(sender.send(event));
        let service = InferenceService::launch(program, limits, Vec::new(), events_of)?;
        let socket = service.connect(self.add.clone(), vec![self.model.clone()])?;
        let mut client = ModelClient::new(socket);
        let open = ModelCall::Open { model: self.add.models[0].name.clone() };
        // Its report is awaited instead of the reply.
        client.call(open, None, Some(Instant::now()))?;
        let mut error = LastError::default();
        loop {
            match events.recv_timeout(POLL_INTERVAL) {
                Ok(InferenceEvent::Report(InferenceReport::Model(_))) => return Ok(None),
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
        }
    }
}
