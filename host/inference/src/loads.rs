//! The order of loads, one at a time: the earliest deadline first.

use crate::engine_error::quoted;
use crate::lambdas::LambdaTable;
use crate::loader::LoadJob;
use crate::sessions::{SessionId, SessionTable};

/// The models that wait to be loaded, and the one that is being loaded.
#[derive(Default)]
pub(crate) struct LoadQueue {
    waiting: Vec<LoadJob>,
    current: Option<CurrentLoad>,
}

struct CurrentLoad {
    session: SessionId,
    /// Its model and its lambdas, for messages.
    name: String,
}

impl LoadQueue {
    pub(crate) fn push(&mut self, job: LoadJob) {
        self.waiting.push(job);
    }

    /// Begins the next load, if none is in progress. A model that no lambda waits for any more is
    /// removed.
    pub(crate) fn begin(
        &mut self,
        lambdas: &LambdaTable,
        sessions: &mut SessionTable,
    ) -> Option<LoadJob> {
        if self.current.is_some() {
            return None;
        }
        self.waiting.retain(|job| {
            let is_wanted = !lambdas.with_call_on(job.session).is_empty();
            if !is_wanted {
                sessions.remove(job.session);
            }
            is_wanted
        });
        let deadline = |index: &usize| {
            let deadline = lambdas.deadline_of(self.waiting[*index].session);
            (deadline.unwrap_or(u64::MAX), *index)
        };
        let next = (0..self.waiting.len()).min_by_key(deadline)?;
        let job = self.waiting.remove(next);
        let name = format!("`{}` of lambda {}", job.path, quoted(&job.lambdas));
        self.current = Some(CurrentLoad { session: job.session, name });
        Some(job)
    }

    pub(crate) fn end(&mut self) {
        self.current = None;
    }

    /// Returns the model that is being loaded, with its lambdas, if it is another one.
    pub(crate) fn other_than(&self, session: SessionId) -> Option<&str> {
        self.current.as_ref().filter(|load| load.session != session).map(|load| &*load.name)
    }
}
