//! All connected lambdas, and the wait for their messages.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

use gleaner_protocol::inference::AddClient;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use tracing::error;

use crate::client::{CallStage, ConnectedLambda, LambdaId, OpenCall};
use crate::loader::PassedModel;
use crate::sessions::{SessionId, SessionKey};

/// Most lambdas that are served at a time. Each has a socket and two regions.
const LAMBDAS: usize = 512;

/// The reason why calls of further lambdas fail.
pub(crate) const TOO_MANY: &str = "gleaner-inference serves 512 lambdas, and this one came later: \
                                   stop others, or start it in a `gleaner run` of its own";

#[derive(Debug, Default)]
pub(crate) struct LambdaTable {
    lambdas: BTreeMap<LambdaId, ConnectedLambda>,
    last_id: u64,
}

#[derive(Debug)]
pub(crate) struct ReadyDescriptors {
    pub(crate) control: bool,
    pub(crate) stop: bool,
    pub(crate) results: bool,
    pub(crate) lambdas: Vec<LambdaId>,
}

impl LambdaTable {
    pub(crate) fn add(&mut self, add: AddClient, socket: OwnedFd, files: Vec<PassedModel>) {
        if self.lambdas.len() >= LAMBDAS {
            error!(lambda = add.name, "more than {LAMBDAS} lambdas: this one gets no model");
        }
        self.last_id += 1;
        self.lambdas.insert(LambdaId(self.last_id), ConnectedLambda::new(add, socket, files));
    }

    /// Returns whether a lambda is not served, as there are too many before it. It is once one of
    /// them has left.
    pub(crate) fn is_beyond(&self, id: LambdaId) -> bool {
        self.lambdas.keys().nth(LAMBDAS).is_some_and(|first| id >= *first)
    }

    pub(crate) fn get_mut(&mut self, id: LambdaId) -> Option<&mut ConnectedLambda> {
        self.lambdas.get_mut(&id)
    }

    /// Removes those that are not served any more; returns their calls.
    pub(crate) fn remove_gone(&mut self) -> Vec<(LambdaId, OpenCall)> {
        let gone = self.lambdas.extract_if(.., |_, lambda| lambda.is_gone);
        gone.filter_map(|(id, lambda)| Some((id, lambda.call?))).collect()
    }

    pub(crate) fn len(&self) -> u64 {
        self.lambdas.len() as u64
    }

    /// Returns the number of calls that wait for a model or for other runs.
    pub(crate) fn waiting(&self) -> u64 {
        let waiting = self.calls().filter(|call| !matches!(call.stage, CallStage::Running(_)));
        waiting.count() as u64
    }

    pub(crate) fn next_deadline(&self) -> Option<u64> {
        self.calls().filter_map(|call| call.deadline_ns).min()
    }

    /// Returns the lambdas whose call is not answered at its deadline.
    pub(crate) fn late(&self, now_ns: u64) -> Vec<LambdaId> {
        self.with_call(|call| call.deadline_ns.is_some_and(|deadline| deadline <= now_ns))
    }

    pub(crate) fn with_call_on(&self, session: SessionId) -> Vec<LambdaId> {
        self.with_call(|call| call.session == session)
    }

    /// Returns the earliest deadline of the calls about a session.
    pub(crate) fn deadline_of(&self, session: SessionId) -> Option<u64> {
        let calls = self.calls().filter(|call| call.session == session);
        calls.filter_map(|call| call.deadline_ns).min()
    }

    /// Returns the names of the lambdas that may use a session.
    pub(crate) fn users(&self, key: &SessionKey) -> Vec<String> {
        let users = self.lambdas.values().filter(|lambda| lambda.uses(key));
        users.map(|lambda| lambda.name.clone()).collect()
    }

    pub(crate) fn use_session(&self, key: &SessionKey) -> bool {
        self.lambdas.values().any(|lambda| lambda.uses(key))
    }

    /// Begins a second, in which each lambda may send a number of messages.
    pub(crate) fn begin_second(&mut self) {
        self.lambdas.values_mut().for_each(ConnectedLambda::reset_messages);
    }

    /// Waits until a lambda sends something, or one of the others is readable, or `timeout` is
    /// over.
    pub(crate) fn wait(
        &self,
        control: impl AsFd,
        results: impl AsFd,
        stop: Option<&OwnedFd>,
        timeout: Duration,
    ) -> io::Result<ReadyDescriptors> {
        let mut polled =
            vec![PollFd::new(&control, PollFlags::IN), PollFd::new(&results, PollFlags::IN)];
        polled.extend(self.lambdas.values().map(|lambda| {
            // While it may not send, only its end is of interest.
            let reads = if lambda.may_send() { PollFlags::IN } else { PollFlags::empty() };
            PollFd::new(lambda, reads)
        }));
        polled.extend(stop.map(|stop| PollFd::new(stop, PollFlags::IN)));
        let timeout = Timespec {
            tv_sec: timeout.as_secs().cast_signed(),
            tv_nsec: timeout.subsec_nanos().into(),
        };
        match poll(&mut polled, Some(&timeout)) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        let mut found = polled.iter().map(|polled| !polled.revents().is_empty());
        let (control, results) = (found.next() == Some(true), found.next() == Some(true));
        let ready = self.lambdas.keys().zip(found.by_ref().take(self.lambdas.len()));
        let lambdas = ready.filter(|(_, is_ready)| *is_ready).map(|(id, _)| *id).collect();
        let stop = found.next() == Some(true);
        Ok(ReadyDescriptors { control, stop, results, lambdas })
    }

    fn calls(&self) -> impl Iterator<Item = &OpenCall> {
        self.lambdas.values().filter_map(|lambda| lambda.call.as_ref())
    }

    fn with_call(&self, is_it: impl Fn(&OpenCall) -> bool) -> Vec<LambdaId> {
        let found =
            self.lambdas.iter().filter(|(_, lambda)| lambda.call.as_ref().is_some_and(&is_it));
        found.map(|(id, _)| *id).collect()
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::inference::ModelClient;

    use super::*;

    #[test]
    fn a_lambda_beyond_the_maximum_is_served_once_another_one_has_left() {
        let (_lambda, socket) = ModelClient::pair().unwrap();
        let mut table = LambdaTable::default();
        for _ in 0..=LAMBDAS {
            let add = AddClient { name: "many".to_owned(), ..AddClient::default() };
            table.add(add, socket.try_clone().unwrap(), Vec::new());
        }
        let (first, last) = (LambdaId(1), LambdaId(LAMBDAS as u64 + 1));
        assert!(table.is_beyond(last) && !table.is_beyond(LambdaId(LAMBDAS as u64)));
        table.get_mut(first).unwrap().is_gone = true;
        table.remove_gone();
        assert!(!table.is_beyond(last));
    }
}
