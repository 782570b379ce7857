//! The connection of a lambda's process to `gleaner-inference`.

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::panic::{AssertUnwindSafe, catch_unwind};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::inference::{AddClient, GrantedModel, ModelClient, report_state};
use gleaner_protocol::link::LinkError;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::INFERENCE;
use super::passed_model::PassedModel;

/// A lambda's process.
pub(super) struct Client {
    pub(super) add: AddClient,
    /// The end of `gleaner-inference` of its connection.
    pub(super) socket: OwnedFd,
    /// The files of its models; once they are checked, one for each digest.
    pub(super) models: Vec<PassedModel>,
    /// The newest state of the process, while the connection has no room for it.
    unsent: Option<ProcessState>,
}

/// A state of `gleaner-inference`. Each replaces those before: a lambda opens its models again
/// after either of them.
pub(super) enum ProcessState {
    Started,
    Ended(String),
}

impl Client {
    /// Creates a client; also returns the end of the lambda of its connection.
    pub(super) fn pair(
        add: AddClient,
        models: Vec<PassedModel>,
    ) -> Result<(OwnedFd, Self), Failure> {
        let (lambda_end, socket) = ModelClient::pair().map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot connect to `{INFERENCE}`"), &error)
        })?;
        Ok((lambda_end, Self { add, socket, models, unsent: None }))
    }

    /// Returns the file of a model.
    pub(super) fn file(&self, sha256: &str) -> Option<&PassedModel> {
        self.models.iter().find(|passed| passed.model.sha256 == sha256)
    }

    /// Refuses the models whose files have another digest; returns the reasons.
    pub(super) fn check_files(&mut self) -> Vec<String> {
        self.check_by(Self::refuse_others)
    }

    /// Refuses all models if `check` panics: the next lambda's are checked all the same.
    fn check_by(&mut self, check: impl FnOnce(&mut Self) -> Vec<String>) -> Vec<String> {
        catch_unwind(AssertUnwindSafe(|| check(self))).unwrap_or_else(|_| {
            let AddClient { name: lambda, models, .. } = &mut self.add;
            let refuse = |GrantedModel { name, sha256, refused, .. }: &mut GrantedModel| {
                let digits = sha256.get(..8).unwrap_or(sha256);
                let reason = format!(
                    "model `{name}` (SHA-256 {digits}...) of lambda `{lambda}` is refused: the \
                     check of its file failed, see standard error; a restart of the supervisor \
                     tries again"
                );
                refused.insert(reason).clone()
            };
            models.iter_mut().map(refuse).collect()
        })
    }

    /// Keeps one file for each digest, as each other process has a descriptor of each; returns why
    /// the others are refused.
    fn refuse_others(&mut self) -> Vec<String> {
        let mut refused = BTreeMap::new();
        for passed in std::mem::take(&mut self.models) {
            let sha256 = passed.model.sha256.clone();
            if self.has_ended() || self.file(&sha256).is_some() {
                continue;
            }
            if let Some(reason) = passed.mismatch(&self.add.name) {
                refused.insert(sha256, reason);
                continue;
            }
            refused.remove(&sha256);
            self.models.push(passed);
        }
        for granted in &mut self.add.models {
            granted.refused = refused.get(&granted.sha256).cloned();
        }
        refused.into_values().collect()
    }

    /// Sends a state of the process, at once or once the lambda has read earlier ones. Returns
    /// whether the lambda's process still runs.
    pub(super) fn report(&mut self, state: ProcessState) -> bool {
        self.unsent = Some(state);
        self.send_state()
    }

    /// Sends the state that had no room.
    pub(super) fn send_state(&mut self) -> bool {
        let reason = match &self.unsent {
            Some(ProcessState::Ended(reason)) => Some(reason.as_str()),
            Some(ProcessState::Started) => None,
            None => return true,
        };
        match report_state(&self.socket, reason) {
            Ok(()) => self.unsent = None,
            Err(LinkError::Gone { .. }) => return false,
            // It does not read, or the system has no memory: the caller tries again.
            Err(_) => {}
        }
        true
    }

    /// Returns whether a state has had no room yet.
    pub(super) fn has_unsent(&self) -> bool {
        self.unsent.is_some()
    }

    /// Returns whether the lambda's process has closed its end of the connection.
    pub(super) fn has_ended(&self) -> bool {
        let mut polled = [PollFd::new(&self.socket, PollFlags::empty())];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut polled, Some(&now)).is_ok() && polled[0].revents().contains(PollFlags::HUP)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use gleaner_protocol::inference::{ModelEngine, ModelFile, ModelResult};

    use super::*;

    #[test]
    fn a_file_that_is_passed_again_is_not_refused_and_is_kept_once() {
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(b"abc").unwrap();
        let file = Arc::new(file);
        let models = [abc, abc, "00"].map(|sha256| {
            let (sha256, path) = (sha256.to_owned(), "m.onnx".to_owned());
            let model = ModelFile { sha256, path, engine: ModelEngine::None };
            PassedModel { model, file: Arc::clone(&file), engine: None }
        });
        let add = r#"{"id": "", "name": "any", "memory": 0, "models":
            [{"name": "m", "sha256": "00", "providers": []}]}"#;
        for _ in 0..2 {
            let add = serde_json::from_str(add).unwrap();
            let (_lambda, mut client) = Client::pair(add, models.to_vec()).unwrap();
            let reason = client.check_files().concat();
            let begin = format!(
                "model `m.onnx` of lambda `any` is refused: the file has the SHA-256 {abc}"
            );
            assert!(reason.starts_with(&begin), "{reason}");
            assert_eq!(
                (client.add.models[0].refused.as_ref(), client.models.len()),
                (Some(&reason), 1)
            );
        }
    }

    #[test]
    fn a_check_that_panics_refuses_the_models_of_its_lambda_by_name() {
        let add = r#"{"id": "", "name": "any", "memory": 0, "models":
            [{"name": "m", "sha256": "00", "providers": []}]}"#;
        let add = serde_json::from_str(add).unwrap();
        let (_lambda, mut client) = Client::pair(add, Vec::new()).unwrap();
        let reasons = client.check_by(|_| panic!("of a test"));
        assert!(reasons[0].starts_with("model `m` (SHA-256 00...) of lambda `any` is refused"));
        assert_eq!(client.add.models[0].refused, reasons.first().cloned());
    }

    #[test]
    fn a_lambda_that_does_not_read_keeps_its_connection_and_reads_the_last_state_at_the_end() {
        let add = AddClient { name: "busy".to_owned(), ..AddClient::default() };
        let (lambda, mut client) = Client::pair(add, Vec::new()).unwrap();
        while !client.has_unsent() {
            assert!(client.report(ProcessState::Ended("it has ended".to_owned())));
        }
        assert!(client.report(ProcessState::Started));
        let mut lambda = ModelClient::new(lambda);
        let mut last = None;
        while let Some(reply) = lambda.poll().unwrap() {
            last = Some(reply.result);
            assert!(client.send_state());
        }
        assert_eq!(last, Some(Ok(ModelResult::Started)));
        assert!(!client.has_unsent() && !client.has_ended());
        drop(lambda);
        assert!(client.has_ended() && !client.report(ProcessState::Started));
    }
}
