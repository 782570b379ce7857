//! The order of loads, one at a time: the earliest deadline first.

use gleaner_protocol::inference::ModelMemory;

use crate::client::LambdaId;
use crate::engine_error::quoted;
use crate::lambdas::LambdaTable;
use crate::loader::{LoadJob, PassedModel};
use crate::memory;
use crate::sessions::{SessionId, SessionKey, SessionTable};

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
    /// Adds a session, and its load with the file of the lambda `id`.
    pub(crate) fn push(
        &mut self,
        key: SessionKey,
        id: LambdaId,
        lambdas: &mut LambdaTable,
        sessions: &mut SessionTable,
    ) -> Result<SessionId, String> {
        let files = lambdas.get_mut(id).map(|lambda| &lambda.files);
        let file = files.and_then(|it| it.iter().find(|file| file.sha256 == key.sha256)).cloned();
        let Some(PassedModel { path, file, engine, .. }) = file else {
            return Err(format!("the starter passed no file with the digest {}", key.sha256));
        };
        let session = sessions.add(key.clone(), path.clone());
        let lambdas = lambdas.users(&key);
        self.waiting.push(LoadJob { session, key, file, engine, path, lambdas, tried: None });
        Ok(session)
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

    /// Returns whether a load has begun, or its trial.
    pub(crate) fn is_busy(&self) -> bool {
        self.current.is_some()
    }

    pub(crate) fn end(&mut self) {
        self.current = None;
    }

    /// Returns why the load that has begun must not happen, if it takes the memory `asked`.
    pub(crate) fn refusal(&self, asked: ModelMemory, sessions: &SessionTable) -> Option<String> {
        let why = memory::refusal(asked, &sessions.loaded())?;
        Some(format!("model {}: {why}", self.current.as_ref()?.name))
    }

    /// Returns the model that is being loaded, with its lambdas, if it is another one.
    pub(crate) fn other_than(&self, session: SessionId) -> Option<&str> {
        self.current.as_ref().filter(|load| load.session != session).map(|load| &*load.name)
    }
}
