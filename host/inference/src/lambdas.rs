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
use crate::sessions::{SessionId, SessionKey};

/// Most lambdas at a time. Each has a socket and two regions.
const LAMBDAS: usize = 512;

/// All connected lambdas.
#[derive(Debug, Default)]
pub(crate) struct LambdaTable {
    lambdas: BTreeMap<LambdaId, ConnectedLambda>,
    last_id: u64,
}

/// Descriptors with something to do.
#[derive(Debug)]
pub(crate) struct ReadyDescriptors {
    pub(crate) control: bool,
    pub(crate) stop: bool,
    pub(crate) results: bool,
    pub(crate) lambdas: Vec<LambdaId>,
}

impl LambdaTable {
    /// Adds a lambda, unless there are too many.
    pub(crate) fn add(&mut self, add: AddClient, socket: OwnedFd) {
        if self.lambdas.len() >= LAMBDAS {
            error!(lambda = add.name, "more than {LAMBDAS} lambdas: one is not served");
            return;
        }
        self.last_id += 1;
        self.lambdas.insert(LambdaId(self.last_id), ConnectedLambda::new(add, socket));
    }

    pub(crate) fn get_mut(&mut self, id: LambdaId) -> Option<&mut ConnectedLambda> {
        self.lambdas.get_mut(&id)
    }

    /// Removes those that are not served any more; returns their calls.
    pub(crate) fn remove_gone(&mut self) -> Vec<(LambdaId, OpenCall)> {
        let gone = self.lambdas.extract_if(.., |_, lambda| lambda.is_gone);
        gone.filter_map(|(id, lambda)| Some((id, lambda.call?))).collect()
    }

    /// Returns the number of lambdas.
    pub(crate) fn len(&self) -> u64 {
        self.lambdas.len() as u64
    }

    /// Returns the number of calls that wait for a model or for other runs.
    pub(crate) fn waiting(&self) -> u64 {
        let waiting = self.calls().filter(|call| !matches!(call.stage, CallStage::Running(_)));
        waiting.count() as u64
    }

    /// Returns the earliest deadline of a call.
    pub(crate) fn next_deadline(&self) -> Option<u64> {
        self.calls().filter_map(|call| call.deadline_ns).min()
    }

    /// Returns the lambdas whose call is not answered at its deadline.
    pub(crate) fn late(&self, now_ns: u64) -> Vec<LambdaId> {
        self.with_call(|call| call.deadline_ns.is_some_and(|deadline| deadline <= now_ns))
    }

    /// Returns the lambdas whose call is about a session.
    pub(crate) fn with_call_on(&self, session: SessionId) -> Vec<LambdaId> {
        self.with_call(|call| call.session == session)
    }

    /// Returns the names of the lambdas that may use a session.
    pub(crate) fn users(&self, key: &SessionKey) -> Vec<String> {
        let users = self.lambdas.values().filter(|lambda| lambda.uses(key));
        users.map(|lambda| lambda.name.clone()).collect()
    }

    /// Returns whether a lambda may use a session.
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
