//! Loads a model by TensorRT: with an engine that was built before, or from the model, which takes
//! minutes.
//!
//! An engine is used only on the runtime that it was built for.

use std::path::PathBuf;

use gleaner_artifacts::BuiltEngine;
use tracing::warn;

use super::{Backend, BackendError, LoadOptions, LoadedGraph};

/// The command that builds engines.
const BUILD: &str = "gleaner check DIR --build-engines";

#[derive(Debug, Default)]
pub enum EngineUse {
    #[default]
    None,
    Built(BuiltEngine),
    Refused(String),
    /// It is built, and written to this file.
    Build(PathBuf),
}

/// Loads `model`, or `engine` in its place. Adds to `notes` what it found about the engine. Returns
/// the name of the runtime as well if it has built an engine.
pub(super) fn load_tensorrt(
    backend: &dyn Backend,
    model: Vec<u8>,
    options: &LoadOptions<'_>,
    engine: EngineUse,
    notes: &mut Vec<String>,
) -> Result<(Box<dyn LoadedGraph>, Option<String>), BackendError> {
    let runtime = backend.engine_runtime();
    let is_refused = !matches!(engine, EngineUse::None);
    let note = match engine {
        EngineUse::Build(path) => {
            let graph = backend.load(model, &LoadOptions { engine: Some(&path), ..*options })?;
            if !path.is_file() {
                return Err(BackendError::new(
                    "it wrote no engine: TensorRT does not run the whole model, or ONNX Runtime is \
                     older than 1.18",
                ));
            }
            return Ok((graph, Some(runtime)));
        }
        EngineUse::Built(built) if built.runtime == runtime => {
            match backend.load(built.model, options) {
                Ok(graph) => {
                    notes.push("its engine was built ahead".to_owned());
                    return Ok((graph, None));
                }
                Err(error) => format!("its engine cannot be used: {error}"),
            }
        }
        EngineUse::Built(BuiltEngine { runtime: other, .. }) => {
            format!("its engine was built for another runtime ({other}) than this ({runtime})")
        }
        EngineUse::Refused(why) => format!("its engine is not used: {why}"),
        EngineUse::None => "no engine was built ahead".to_owned(),
    };
    let note = format!("{note}: {BUILD}");
    if is_refused {
        // Now, as the process ends if it takes too long.
        warn!(reason = note, "TensorRT compiles a model again, which takes minutes");
    }
    let loaded = backend.load(model, options);
    // Without a GPU, an engine would not help.
    if is_refused || loaded.is_ok() {
        notes.push(note);
    }
    Ok((loaded?, None))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::super::ExecutionProvider;
    use super::super::tests::FakeGraph;
    use super::*;
    use crate::inspect::ModelSignature;

    /// Builds the engine `engine of MODEL`, and loads no other.
    struct FakeTensorRt {
        runtime: &'static str,
        writes: bool,
    }

    impl Backend for FakeTensorRt {
        fn version(&self) -> String {
            "fake 1".to_owned()
        }

        fn engine_runtime(&self) -> String {
            self.runtime.to_owned()
        }

        fn load(
            &self,
            model: Vec<u8>,
            options: &LoadOptions<'_>,
        ) -> Result<Box<dyn LoadedGraph>, BackendError> {
            if let Some(path) = options.engine.filter(|_| self.writes) {
                fs::write(path, [b"engine of ", &model[..]].concat()).unwrap();
            }
            match &model[..] {
                b"model" | b"engine of model" => Ok(Box::new(FakeGraph)),
                _ => Err(BackendError::new("it is not an engine of this model")),
            }
        }
    }

    /// Returns the runtime of the engine that was built, and the notes, or the error.
    fn loaded(
        backend: &FakeTensorRt,
        model: &[u8],
        engine: EngineUse,
    ) -> Result<(Option<String>, String), String> {
        let (signature, mut notes) = (ModelSignature::default(), Vec::new());
        let options = LoadOptions {
            provider: ExecutionProvider::TensorRt,
            threads: 1,
            signature: &signature,
            engine: None,
        };
        let graph = load_tensorrt(backend, model.to_vec(), &options, engine, &mut notes);
        graph.map(|(_, built_for)| (built_for, notes.join("; "))).map_err(|error| error.to_string())
    }

    fn built(runtime: &str, model: &[u8]) -> EngineUse {
        EngineUse::Built(BuiltEngine { runtime: runtime.to_owned(), model: model.to_vec() })
    }

    const ORIN: FakeTensorRt = FakeTensorRt { runtime: "Orin", writes: true };

    #[test]
    fn an_engine_replaces_the_model_only_on_its_own_runtime_and_each_refusal_is_noted() {
        let note = |engine| loaded(&ORIN, b"model", engine).unwrap().1;
        assert_eq!(
            loaded(&ORIN, b"other", built("Orin", b"engine of model")),
            Ok((None, "its engine was built ahead".to_owned())),
            "the model would be refused"
        );
        let how = "gleaner check DIR --build-engines";
        assert_eq!(note(EngineUse::None), format!("no engine was built ahead: {how}"));
        assert_eq!(
            note(built("A2", b"engine of model")),
            format!("its engine was built for another runtime (A2) than this (Orin): {how}")
        );
        assert_eq!(
            note(built("Orin", b"engine of another")),
            format!("its engine cannot be used: it is not an engine of this model: {how}")
        );
        let damaged = EngineUse::Refused("it is too short".to_owned());
        assert_eq!(note(damaged), format!("its engine is not used: it is too short: {how}"));
    }

    #[test]
    fn an_engine_is_built_from_the_model_and_one_that_is_not_written_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("engine.onnx");
        let build = |backend: &FakeTensorRt, path: &Path| {
            loaded(backend, b"model", EngineUse::Build(path.to_owned()))
        };
        let silent = FakeTensorRt { writes: false, ..ORIN };
        assert!(build(&silent, &path).unwrap_err().starts_with("it wrote no engine"));
        assert_eq!(build(&ORIN, &path), Ok((Some("Orin".to_owned()), String::new())));
        assert_eq!(fs::read(&path).unwrap(), b"engine of model");
        let failed = loaded(&ORIN, b"no model", EngineUse::Build(path));
        assert_eq!(failed, Err("it is not an engine of this model".to_owned()));
    }
}
