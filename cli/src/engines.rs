//! `gleaner check DIR --build-engines`: builds the engines of a lambda's models for TensorRT, and
//! puts them into the store, where later runs find them.
//!
//! A process of its own builds each: a hostile model can spoil no engine but its own.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use gleaner_artifacts::{BuiltEngine, DerivedEntry, DerivedKind, make_store};
use gleaner_base::programs::{InstalledPrograms, cache_dir};
use gleaner_base::{ByteSize, Exit, Failure, PlainFile, chain, visible};
use gleaner_lambda::manifest::{Manifest, ModelSpec};
use gleaner_lambda::{BuildDir, InferenceLimits};
use gleaner_protocol::inference::{
    InferenceReport, ModelCall, ModelClient, ModelState, engine_file,
};
use gleaner_supervisor::{InferenceEvent, InferenceService, InferenceUse};
use serde::Serialize;

use crate::output::{print, print_error, print_json};
use crate::run::stop_flag;

/// Provider that has engines.
const TENSORRT: &str = "tensorrt";

const BUILD_MAX: Duration = Duration::from_secs(3 * 3600);

/// Memory that a build may take. TensorRT needs several times that of the model.
const BUILD_MEMORY: ByteSize = ByteSize::gib(8);

/// The way out for a model whose engine cannot be made or used.
const SMALLER: &str = "use a smaller model, or leave `tensorrt` out of its `providers`";

const PROGRESS_INTERVAL: Duration = Duration::from_secs(5);

const POLL_INTERVAL: Duration = Duration::from_millis(100);

#[derive(Debug, Serialize)]
struct EngineResult {
    model: String,
    sha256: String,
    /// The engine; `None` if TensorRT is not among the providers of the model.
    engine: Option<EngineBuilt>,
}

#[derive(Debug, Serialize)]
struct EngineBuilt {
    runtime: String,
    seconds: f64,
    bytes: u64,
}

/// Builds the engines of the models of the lambda in the folder `lambda`, and prints the result.
pub(crate) fn build(lambda: &Path, is_json: bool) -> Result<Exit, Failure> {
    let (parts, build) = (InstalledPrograms::find()?, BuildDir::check_fresh(lambda)?);
    let manifest = Manifest::load(build.path())?;
    let store = cache_dir()?;
    make_store(&store)?;
    let stop = stop_flag()?;
    // Before minutes of work whose result could not be used.
    for model in &manifest.models {
        DerivedEntry::of(&store, BuiltEngine::key(model.sha256.as_str())).open()?;
    }
    let mut results = Vec::new();
    for model in &manifest.models {
        let is_listed = model.providers.iter().any(|name| name == TENSORRT);
        let engine = is_listed.then(|| {
            EngineBuild { parts: &parts, build: &build, manifest: &manifest, model, stop: &stop }
                .run(&store)
        });
        let engine = match engine.transpose() {
            Ok(engine) => engine,
            Err(failure) => {
                if is_json {
                    print_json(&results)?;
                }
                return Err(failure);
            }
        };
        let (model, sha256) = (model.file.to_string(), model.sha256.to_string());
        let result = EngineResult { model, sha256, engine };
        if !is_json {
            print(&result.text())?;
        }
        results.push(result);
    }
    if is_json {
        print_json(&results)?;
    } else if results.is_empty() {
        print("the lambda has no models: there is nothing to build\n")?;
    }
    Ok(Exit::Ok)
}

impl EngineResult {
    fn text(&self) -> String {
        let model = format!("model `{}`", visible(&self.model));
        match &self.engine {
            None => format!("{model}: nothing to build: its `providers` do not name `tensorrt`\n"),
            Some(EngineBuilt { runtime, seconds, bytes }) => format!(
                "{model}: engine of {:.1} MiB built in {seconds:.0} s for {}\n",
                *bytes as f64 / f64::from(1 << 20),
                visible(runtime)
            ),
        }
    }
}

struct EngineBuild<'a> {
    parts: &'a InstalledPrograms,
    build: &'a BuildDir,
    manifest: &'a Manifest,
    model: &'a ModelSpec,
    stop: &'a AtomicBool,
}

impl EngineBuild<'_> {
    fn run(&self, store: &Path) -> Result<EngineBuilt, Failure> {
        let begin = Instant::now();
        self.show("building its engine, which takes minutes");
        let folder = tempfile::Builder::new()
            .prefix("gleaner-engine-")
            .permissions(PermissionsExt::from_mode(0o700))
            .tempdir()
            .map_err(|error| self.failed(chain(&error)))?;
        let runtime = self.built_in(folder.path(), begin)?;
        let sha256 = self.model.sha256.as_str();
        let max = ByteSize::new(DerivedKind::Engine.max_bytes() as u64);
        let engine = PlainFile::inside(folder.path(), Path::new(&engine_file(sha256)), max)
            .and_then(PlainFile::read_whole)
            .map_err(|error| self.failed(chain(&error)).with_help(SMALLER))?;
        BuiltEngine::put(store, sha256, &runtime, &engine)?;
        let (seconds, bytes) = (begin.elapsed().as_secs_f64(), engine.len() as u64);
        Ok(EngineBuilt { runtime, seconds, bytes })
    }

    /// Has a process write the engine into `folder`; returns the name of its runtime.
    fn built_in(&self, folder: &Path, begin: Instant) -> Result<String, Failure> {
        let (sender, events) = channel();
        let limits = InferenceLimits {
            memory: BUILD_MEMORY,
            load_max: BUILD_MAX,
            ..InferenceLimits::default()
        };
        // Sending fails only after the end of the build.
        let purpose = InferenceUse::Engines(folder);
        let service = InferenceService::start(self.parts, &limits, purpose, move |event| {
            drop(sender.send(event));
        })?;
        let mut model = self.model.clone();
        model.providers = vec![TENSORRT.to_owned()];
        let mut manifest = self.manifest.clone();
        manifest.models = vec![model];
        let socket = service.add(manifest.lambda.name.as_str(), self.build, &manifest)?;
        let mut client = ModelClient::new(socket);
        let open = ModelCall::Open { model: self.model.name.to_string() };
        // The report of the process is awaited instead of the reply.
        client.call(open, None, Some(Instant::now()))?;
        let built = self.follow(&events, begin);
        service.stop();
        built
    }

    /// Shows what the process reports, until the engine is built.
    fn follow(&self, events: &Receiver<InferenceEvent>, begin: Instant) -> Result<String, Failure> {
        let mut shown = begin;
        loop {
            match events.recv_timeout(POLL_INTERVAL) {
                Ok(InferenceEvent::Report(InferenceReport::Model(model))) => {
                    return match (model.state, model.built_for) {
                        (ModelState::Ready, Some(runtime)) => Ok(runtime),
                        _ => Err(self.failed(visible(&model.reason)).with_help(
                            "models run by TensorRT need its libraries, an NVIDIA GPU and fixed \
                             sizes of tensors; see docs/models.md",
                        )),
                    };
                }
                Ok(InferenceEvent::Ended(reason, ..)) => {
                    return Err(self.failed(visible(&reason)).with_help(SMALLER));
                }
                Ok(InferenceEvent::Stderr(text)) => print_error(&String::from_utf8_lossy(&text)),
                Ok(InferenceEvent::Warning(text)) => self.show(&text),
                Ok(InferenceEvent::Refused(text)) => return Err(self.failed(visible(&text))),
                Ok(InferenceEvent::Report(_)) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(self.failed("its process is not supervised"));
                }
            }
            if self.stop.load(Ordering::Relaxed) {
                return Err(self.failed("it was interrupted"));
            }
            if shown.elapsed() >= PROGRESS_INTERVAL {
                shown = Instant::now();
                self.show(&format!("still building, {:.0} s", begin.elapsed().as_secs_f64()));
            }
        }
    }

    fn show(&self, text: &str) {
        print_error(&format!("model `{}`: {}\n", self.model.file, visible(text)));
    }

    fn failed(&self, cause: impl Into<String>) -> Failure {
        let message = format!("cannot build the engine of model `{}`", self.model.name);
        Failure { causes: vec![cause.into()], ..Failure::new(Exit::Internal, message) }
    }
}
