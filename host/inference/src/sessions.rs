//! The models that are loaded or being loaded, and their counts.
//!
//! A session is shared by all lambdas that name the same file with the same options.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{LoadedModel, ModelMemory, ModelResult, ModelState, TensorInfo};

use crate::memory;

/// Time for which a session without lambdas is kept, while there is memory: a lambda that is
/// restarted finds it loaded.
const KEPT: Duration = Duration::from_secs(60);

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct SessionId(u64);

/// The file and the options of a session.
pub(crate) use gleaner_protocol::inference::TryLoad as SessionKey;

#[derive(Debug, Clone)]
pub(crate) enum LoadState {
    Loading,
    Ready(ReadyModel),
    Failed(String),
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReadyModel {
    pub(crate) inputs: Vec<TensorInfo>,
    pub(crate) outputs: Vec<TensorInfo>,
    pub(crate) metadata: Vec<(String, String)>,
    pub(crate) runtime: String,
    pub(crate) reason: String,
    /// Name of the runtime of the engine that was built.
    pub(crate) built_for: Option<String>,
    /// Time to load it and to run it once, in ns.
    pub(crate) load_ns: u64,
    pub(crate) memory: ModelMemory,
}

impl ReadyModel {
    pub(crate) fn opened(&self) -> ModelResult {
        let Self { inputs, outputs, runtime, metadata, .. } = self.clone();
        ModelResult::Opened { inputs, outputs, runtime, metadata }
    }
}

/// A model with its options.
#[derive(Debug)]
pub(crate) struct ModelSession {
    pub(crate) key: SessionKey,
    pub(crate) path: String,
    pub(crate) state: LoadState,
    pub(crate) counts: RunCounts,
    /// Time at which the last lambda disconnected.
    unused_since: Option<Instant>,
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RunCounts {
    pub(crate) runs: u64,
    pub(crate) shared: u64,
    pub(crate) failed: u64,
    pub(crate) run_ns: u64,
}

#[derive(Debug, Default)]
pub(crate) struct SessionTable {
    sessions: BTreeMap<SessionId, ModelSession>,
    last_id: u64,
}

impl SessionTable {
    pub(crate) fn find(&self, key: &SessionKey) -> Option<SessionId> {
        self.sessions.iter().find(|(_, session)| session.key == *key).map(|(id, _)| *id)
    }

    pub(crate) fn get(&self, id: SessionId) -> Option<&ModelSession> {
        self.sessions.get(&id)
    }

    pub(crate) fn get_mut(&mut self, id: SessionId) -> Option<&mut ModelSession> {
        self.sessions.get_mut(&id)
    }

    /// Adds a session that is being loaded.
    pub(crate) fn add(&mut self, key: SessionKey, path: String) -> SessionId {
        self.last_id += 1;
        let id = SessionId(self.last_id);
        let session = ModelSession {
            key,
            path,
            state: LoadState::Loading,
            counts: RunCounts::default(),
            unused_since: None,
        };
        self.sessions.insert(id, session);
        id
    }

    pub(crate) fn remove(&mut self, id: SessionId) {
        self.sessions.remove(&id);
    }

    /// Returns the paths and the memory of the models that are loaded.
    pub(crate) fn loaded(&self) -> Vec<(&str, ModelMemory)> {
        let loaded = self.sessions.values().filter_map(|session| match &session.state {
            LoadState::Ready(ready) => Some((&*session.path, ready.memory)),
            _ => None,
        });
        loaded.collect()
    }

    pub(crate) fn count_failed(&mut self, id: SessionId) {
        if let Some(session) = self.get_mut(id) {
            session.counts.failed += 1;
        }
    }

    /// Removes the sessions that no lambda has used for a while, and returns them. One that is
    /// being loaded stays.
    pub(crate) fn remove_unused(
        &mut self,
        is_used: impl Fn(&SessionKey) -> bool,
        now: Instant,
    ) -> Vec<SessionId> {
        let kept = if memory::is_short(2, 0) { Duration::ZERO } else { KEPT };
        let mut removed = Vec::new();
        for (id, session) in &mut self.sessions {
            if is_used(&session.key) || matches!(session.state, LoadState::Loading) {
                session.unused_since = None;
            } else if *session.unused_since.get_or_insert(now) + kept <= now {
                removed.push(*id);
            }
        }
        self.sessions.retain(|id, _| !removed.contains(id));
        removed
    }

    pub(crate) fn report(&self, id: SessionId, lambdas: Vec<String>) -> Option<LoadedModel> {
        self.get(id).map(|session| session.report(lambdas))
    }

    pub(crate) fn reports(&self, lambdas: impl Fn(&SessionKey) -> Vec<String>) -> Vec<LoadedModel> {
        self.sessions.values().map(|session| session.report(lambdas(&session.key))).collect()
    }
}

impl ModelSession {
    fn report(&self, lambdas: Vec<String>) -> LoadedModel {
        let counts = self.counts;
        let (mut built_for, mut memory) = (None, ModelMemory::default());
        let (state, runtime, reason, load_ns) = match &self.state {
            LoadState::Loading => (ModelState::Warming, "", "", 0),
            LoadState::Ready(ready) => {
                (built_for, memory) = (ready.built_for.clone(), ready.memory);
                (ModelState::Ready, &*ready.runtime, &*ready.reason, ready.load_ns)
            }
            LoadState::Failed(reason) => (ModelState::Failed, "", &**reason, 0),
        };
        LoadedModel {
            sha256: self.key.sha256.clone(),
            path: self.path.clone(),
            providers: self.key.providers.clone(),
            threads: self.key.threads,
            lambdas,
            state,
            runtime: runtime.to_owned(),
            reason: reason.to_owned(),
            built_for,
            load_ns,
            runs: counts.runs,
            shared: counts.shared,
            failed: counts.failed,
            run_ns: counts.run_ns,
            memory,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_session_without_lambdas_is_kept_for_a_while_and_then_removed() {
        let mut table = SessionTable::default();
        let key = SessionKey { sha256: "0".repeat(64), providers: Vec::new(), threads: 1 };
        let id = table.add(key.clone(), "m.onnx".to_owned());
        assert_eq!(table.find(&key), Some(id));
        assert_eq!(table.find(&SessionKey { threads: 2, ..key.clone() }), None);
        let start = Instant::now();
        let later = start + KEPT;
        table.remove_unused(|_| false, start);
        assert!(table.remove_unused(|_| false, later).is_empty(), "it is being loaded");
        table.get_mut(id).unwrap().state = LoadState::Failed("broken".to_owned());
        assert!(table.remove_unused(|_| false, start).is_empty());
        assert!(table.remove_unused(|_| true, start).is_empty());
        assert!(table.remove_unused(|_| false, later).is_empty(), "the time begins again");
        table.count_failed(id);
        let report = table.report(id, vec!["a".to_owned()]).unwrap();
        assert_eq!((report.state, &*report.reason), (ModelState::Failed, "broken"));
        assert_eq!((report.failed, table.reports(|_| Vec::new()).len()), (1, 1));
        assert_eq!(table.remove_unused(|_| false, later + KEPT), [id]);
        assert!(table.get(id).is_none());
    }
}
