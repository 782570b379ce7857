//! The thread that checks and loads models, and runs each once: meanwhile others run.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_artifacts::{BuiltEngine, StoreLookup};
use gleaner_base::{chain, hex};
use gleaner_protocol::inference::{
    Element, MAX_TENSOR_BYTES, ModelEngine, ModelFile, ModelMemory, TensorInfo, engine_file,
};
use sha2::{Digest, Sha256};

use crate::backend::{
    Backends, ChosenGraph, EngineUse, ExecutionProvider, LoadedGraph, StopSignal, TensorValue,
};
use crate::inspect::{InspectError, ModelSignature, inspect};
use crate::memory;
use crate::running::{ModelWork, WorkNote};
use crate::sessions::{ReadyModel, SessionId, SessionKey};

/// The entry with the engine of a model, unverified; or the reason why it must not be used.
pub(crate) type PassedEngine = Result<Option<Arc<File>>, String>;

/// The file of a model, which its lambda keeps open.
#[derive(Debug, Clone)]
pub(crate) struct PassedModel {
    pub(crate) sha256: String,
    pub(crate) path: String,
    pub(crate) file: Arc<File>,
    pub(crate) engine: PassedEngine,
}

impl PassedModel {
    pub(crate) fn new(model: ModelFile, file: OwnedFd, entry: Option<OwnedFd>) -> Self {
        let ModelFile { sha256, path, engine } = model;
        let entry = entry.map(|it| Arc::new(File::from(it)));
        let engine = match engine {
            ModelEngine::Refused(reason) => Err(reason),
            ModelEngine::None | ModelEngine::Attached => Ok(entry),
        };
        Self { sha256, path, file: Arc::new(File::from(file)), engine }
    }
}

pub(crate) struct LoadJob {
    pub(crate) session: SessionId,
    pub(crate) key: SessionKey,
    pub(crate) file: Arc<File>,
    pub(crate) engine: PassedEngine,
    pub(crate) path: String,
    pub(crate) lambdas: Vec<String>,
    /// Memory that its trial took.
    pub(crate) tried: Option<ModelMemory>,
}

pub(crate) struct LoadDone {
    pub(crate) session: SessionId,
    /// The model, or the reason why it cannot be used.
    pub(crate) loaded: Result<(Box<dyn LoadedGraph>, ReadyModel), String>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct LoadLimits {
    /// Largest size of a file, in bytes.
    pub(crate) model_max: u64,
    pub(crate) load_max: Duration,
    pub(crate) run_max: Duration,
}

pub(crate) struct ModelLoader {
    pub(crate) backends: Backends,
    pub(crate) limits: LoadLimits,
    /// Folder to write engines to, instead of using those that were built before.
    pub(crate) engines: Option<PathBuf>,
    pub(crate) note: WorkNote,
}

#[derive(Debug, thiserror::Error)]
enum ModelError {
    #[error("it cannot be read")]
    Read(#[source] io::Error),
    #[error("it is not a regular file")]
    NoFile,
    #[error("it has {bytes} bytes; {max} are allowed")]
    TooLarge { bytes: u64, max: u64 },
    #[error("there is no memory for its {bytes} bytes")]
    NoMemory { bytes: u64 },
    #[error("its SHA-256 is {found}, and the lambda needs {needed}")]
    Digest { found: String, needed: String },
    #[error(transparent)]
    Inspect(#[from] InspectError),
    #[error("{0}")]
    Backend(String),
}

impl ModelLoader {
    pub(crate) fn load(&self, job: &LoadJob) -> LoadDone {
        let (limit, stop) = (self.limits.load_max, Arc::new(StopSignal::default()));
        self.note.begin(ModelWork {
            note: job.key.sha256.clone(),
            path: job.path.clone(),
            held: 0,
            lambdas: job.lambdas.clone(),
            until: Instant::now() + limit,
            limit,
            stop: Arc::clone(&stop),
        });
        let loaded = self.load_and_warm(job, &stop);
        self.note.end();
        let failed = |error: ModelError| format!("model `{}`: {}", job.path, chain(&error));
        LoadDone { session: job.session, loaded: loaded.map_err(failed) }
    }

    fn load_and_warm(
        &self,
        job: &LoadJob,
        stop: &StopSignal,
    ) -> Result<(Box<dyn LoadedGraph>, ReadyModel), ModelError> {
        let (start, before) = (Instant::now(), memory::now());
        let model = read(&job.file, &job.key.sha256, self.limits.model_max)?;
        let signature = inspect(&model)?;
        let key = &job.key;
        let engine = self.engine(job);
        let load = || self.backends.load(model, &key.providers, key.threads, &signature, engine);
        let chosen = caught(load);
        let chosen = match chosen {
            Ok(chosen) => chosen.map_err(|error| ModelError::Backend(error.to_string()))?,
            Err(panic) => return Err(ModelError::Backend(format!("loading it failed: {panic}"))),
        };
        let ChosenGraph { mut graph, runtime, mut reason, built_for } = chosen;
        self.note.limit(self.limits.run_max);
        let shapes = match warm(graph.as_mut(), &signature.inputs, stop) {
            Warmed::Ran(outputs) => outputs.into_iter().map(|it| it.shape.len()).collect(),
            Warmed::Skipped => Vec::new(),
            Warmed::Failed(error) => {
                // It may need other values than zeros.
                reason.push_str(&format!("; a run on zeros failed: {error}"));
                Vec::new()
            }
        };
        let ModelSignature { inputs, outputs, metadata, .. } = signature;
        let ranks = shapes.into_iter().map(Some).chain(std::iter::repeat(None));
        let outputs = outputs.into_iter().zip(ranks).map(|(output, rank)| {
            let (mut tensor, has_shape) = (output.tensor, output.has_shape);
            if let (false, Some(rank)) = (has_shape, rank) {
                tensor.shape = vec![None; rank];
            }
            tensor
        });
        let outputs = outputs.collect();
        let load_ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        let has_gpu = [", cuda,", ", tensorrt,"].iter().any(|provider| runtime.contains(provider));
        let taken = memory::taken_since(before);
        let memory = match job.tried {
            _ if has_gpu => memory::without_libraries(taken.held),
            Some(tried) => tried,
            None => taken,
        };
        let ready =
            ReadyModel { inputs, outputs, metadata, runtime, reason, built_for, load_ns, memory };
        Ok((graph, ready))
    }

    /// Returns what to do about an engine, if TensorRT is to load the model.
    fn engine(&self, job: &LoadJob) -> EngineUse {
        let sha256 = &job.key.sha256;
        if !job.key.providers.iter().any(|name| name == ExecutionProvider::TensorRt.name()) {
            return EngineUse::None;
        }
        match (&self.engines, &job.engine) {
            (Some(folder), _) => EngineUse::Build(folder.join(engine_file(sha256))),
            (None, Ok(Some(entry))) => match BuiltEngine::key(sha256).verified(entry) {
                StoreLookup::Content(content) => BuiltEngine::parse(content)
                    .map_or(EngineUse::Refused("it has no runtime".to_owned()), EngineUse::Built),
                StoreLookup::Damaged(why) => EngineUse::Refused(format!("it is damaged: {why}")),
                StoreLookup::Nothing => EngineUse::None,
            },
            (None, Ok(None)) => EngineUse::None,
            (None, Err(reason)) => EngineUse::Refused(reason.clone()),
        }
    }
}

/// Reads the file of a model, and checks its digest on the bytes that are then loaded.
fn read(file: &File, sha256: &str, max: u64) -> Result<Vec<u8>, ModelError> {
    let metadata = file.metadata().map_err(ModelError::Read)?;
    let bytes = metadata.len();
    if !metadata.is_file() {
        return Err(ModelError::NoFile);
    }
    if bytes > max {
        return Err(ModelError::TooLarge { bytes, max });
    }
    let no_memory = || ModelError::NoMemory { bytes };
    let length = usize::try_from(bytes).map_err(|_| no_memory())?;
    let mut model = Vec::new();
    model.try_reserve_exact(length).map_err(|_| no_memory())?;
    model.resize(length, 0);
    file.read_exact_at(&mut model, 0).map_err(ModelError::Read)?;
    let found = hex(&Sha256::digest(&model));
    if !found.eq_ignore_ascii_case(sha256) {
        return Err(ModelError::Digest { found, needed: sha256.to_owned() });
    }
    Ok(model)
}

/// The result of a first run on zeros.
enum Warmed {
    Ran(Vec<TensorValue>),
    /// A shape is not known.
    Skipped,
    Failed(String),
}

fn warm(graph: &mut dyn LoadedGraph, inputs: &[TensorInfo], stop: &StopSignal) -> Warmed {
    let zeros = |info: &TensorInfo| {
        let shape: Vec<u32> = info.shape.iter().copied().collect::<Option<_>>()?;
        let bytes = Element::bytes_of(info.element, &shape)?;
        Some((info.element, shape, bytes))
    };
    let Some(planned) = inputs.iter().map(zeros).collect::<Option<Vec<_>>>() else {
        return Warmed::Skipped;
    };
    if planned.iter().map(|(_, _, bytes)| bytes).sum::<u64>() > MAX_TENSOR_BYTES {
        return Warmed::Skipped;
    }
    let filled = planned.into_iter().map(|(element, shape, length)| {
        let bytes = vec![0; length as usize];
        TensorValue { element, shape, bytes }
    });
    let values: Vec<TensorValue> = filled.collect();
    match caught(|| graph.run(&values, stop)) {
        Ok(Ok(outputs)) => Warmed::Ran(outputs),
        Ok(Err(error)) => Warmed::Failed(error.to_string()),
        Err(panic) => Warmed::Failed(panic),
    }
}

/// Calls a backend; returns the message of a panic.
pub(crate) fn caught<T>(call: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        format!("the library panicked: {}", text.unwrap_or_default())
    })
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn the_digest_is_checked_on_the_bytes_that_are_loaded() {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(b"abc").unwrap();
        let digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(read(&file, digest, 3).unwrap(), b"abc");
        assert_eq!(read(&file, &digest.to_uppercase(), 3).unwrap(), b"abc");
        let refusal = |sha256: &str, max| read(&file, sha256, max).unwrap_err().to_string();
        assert_eq!(refusal(digest, 2), "it has 3 bytes; 2 are allowed");
        assert_eq!(refusal("00", 3), format!("its SHA-256 is {digest}, and the lambda needs 00"));
        let device = File::open("/dev/zero").unwrap();
        assert!(matches!(read(&device, digest, 3), Err(ModelError::NoFile)));
    }

    #[test]
    fn a_panic_of_a_library_is_an_error() {
        let panic = caught(|| panic!("index {}", 7)).unwrap_err();
        assert_eq!(panic, "the library panicked: index 7");
    }
}
