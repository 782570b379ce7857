//! The order of loads, one at a time: the earliest deadline first; and the files of models that the
//! starter has passed.

use std::collections::HashMap;
use std::fs::File;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use gleaner_protocol::inference::{ModelEngine, ModelFile};

use crate::engine_error::quoted;
use crate::lambdas::LambdaTable;
use crate::loader::{LoadJob, PassedEngine};
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

    /// Returns whether a load has begun, or its trial.
    pub(crate) fn is_busy(&self) -> bool {
        self.current.is_some()
    }

    pub(crate) fn end(&mut self) {
        self.current = None;
    }

    /// Returns the model that is being loaded, with its lambdas, if it is another one.
    pub(crate) fn other_than(&self, session: SessionId) -> Option<&str> {
        self.current.as_ref().filter(|load| load.session != session).map(|load| &*load.name)
    }
}

/// The files, by their digests.
#[derive(Default)]
pub(crate) struct PassedFiles(HashMap<String, PassedModel>);

struct PassedModel {
    path: String,
    file: Arc<File>,
    engine: PassedEngine,
}

impl PassedFiles {
    pub(crate) fn add(&mut self, model: ModelFile, file: OwnedFd, entry: Option<OwnedFd>) {
        let ModelFile { sha256, path, engine } = model;
        let entry = entry.map(|it| Arc::new(File::from(it)));
        let engine = match engine {
            ModelEngine::Refused(reason) => Err(reason),
            ModelEngine::None | ModelEngine::Attached => Ok(entry),
        };
        let file = Arc::new(File::from(file));
        self.0.insert(sha256, PassedModel { path, file, engine });
    }

    /// Adds a session, and its load to `loads`.
    pub(crate) fn load(
        &self,
        key: SessionKey,
        lambdas: &LambdaTable,
        sessions: &mut SessionTable,
        loads: &mut LoadQueue,
    ) -> Result<SessionId, String> {
        let Some(PassedModel { path, file, engine }) = self.0.get(&key.sha256) else {
            return Err(format!("the starter passed no file with the digest {}", key.sha256));
        };
        let (path, file, engine) = (path.clone(), Arc::clone(file), engine.clone());
        let session = sessions.add(key.clone(), path.clone());
        let lambdas = lambdas.users(&key);
        loads.push(LoadJob { session, key, file, engine, path, lambdas });
        Ok(session)
    }
}
