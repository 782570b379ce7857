//! Chooses backend and provider of a model: tries those of the manifest in order, and keeps the
//! error of each.

use super::tensorrt::{EngineUse, load_tensorrt};
use super::{Backend, BackendError, ExecutionProvider, LoadOptions, LoadedGraph};
use crate::inspect::ModelSignature;

/// Names in the manifest.
const KNOWN: &str = "cpu, cuda, tensorrt, rten and onnxruntime";

pub struct Backends {
    rten: Box<dyn Backend>,
    onnx_runtime: Result<Box<dyn Backend>, String>,
}

/// A loaded model, with the reason for its backend.
pub struct ChosenGraph {
    pub graph: Box<dyn LoadedGraph>,
    /// Backend, version, provider and threads, such as `rten 0.27.0, cpu, 1 thread`.
    pub runtime: String,
    /// The reason for this choice, with the errors of those that were tried before.
    pub reason: String,
    /// Name of the runtime of the engine that was built.
    pub built_for: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Library {
    Rten,
    OnnxRuntime,
}

#[derive(Debug, Clone, Copy)]
struct NamedProvider<'a> {
    name: &'a str,
    library: Library,
    provider: ExecutionProvider,
}

impl Backends {
    /// Uses these backends. Without a library of ONNX Runtime, its place has the reason.
    pub fn new(rten: Box<dyn Backend>, onnx_runtime: Result<Box<dyn Backend>, String>) -> Self {
        Self { rten, onnx_runtime }
    }

    /// Loads a model with the first of `providers` that can run it; with any if none is named.
    /// TensorRT uses or builds an engine, by `engine`.
    ///
    /// # Errors
    ///
    /// An unknown provider, or the error of each provider.
    pub fn load(
        &self,
        model: Vec<u8>,
        providers: &[String],
        threads: u32,
        signature: &ModelSignature,
        engine: EngineUse,
    ) -> Result<ChosenGraph, BackendError> {
        let any = ["cpu".to_owned()];
        let names = if providers.is_empty() { &any[..] } else { providers };
        let named: Vec<NamedProvider<'_>> =
            names.iter().map(|name| self.named(name)).collect::<Result<_, _>>()?;
        let mut errors = Vec::new();
        let (mut model, mut engine, last) = (Some(model), engine, named.len() - 1);
        for (index, named) in named.iter().enumerate() {
            // The bytes are needed again only if another one may be tried.
            let bytes = if index == last { model.take() } else { model.clone() };
            let bytes = bytes.unwrap_or_default();
            let options =
                LoadOptions { provider: named.provider, threads, signature, engine: None };
            let mut notes = Vec::new();
            let loaded = self.backend(named.library).and_then(|backend| {
                let (graph, built_for) = if named.provider == ExecutionProvider::TensorRt {
                    load_tensorrt(
                        backend,
                        bytes,
                        &options,
                        std::mem::take(&mut engine),
                        &mut notes,
                    )?
                } else {
                    (backend.load(bytes, &options)?, None)
                };
                Ok((backend.version(), graph, built_for))
            });
            match loaded {
                Ok((version, graph, built_for)) => {
                    let plural = if threads == 1 { "" } else { "s" };
                    let provider = named.provider.name();
                    let runtime = format!("{version}, {provider}, {threads} thread{plural}");
                    let choice = self.reason(providers, named, &errors);
                    let reason = [&[choice], &notes[..]].concat().join("; ");
                    return Ok(ChosenGraph { graph, runtime, reason, built_for });
                }
                Err(error) => {
                    errors.append(&mut notes);
                    errors.push(format!("`{}` failed: {error}", named.name));
                }
            }
        }
        Err(BackendError::new(errors.join("; ")))
    }

    fn named<'a>(&self, name: &'a str) -> Result<NamedProvider<'a>, BackendError> {
        let (library, provider) = match name {
            "cpu" if self.onnx_runtime.is_err() => (Library::Rten, ExecutionProvider::Cpu),
            "cpu" | "onnxruntime" => (Library::OnnxRuntime, ExecutionProvider::Cpu),
            "rten" => (Library::Rten, ExecutionProvider::Cpu),
            "cuda" => (Library::OnnxRuntime, ExecutionProvider::Cuda),
            "tensorrt" => (Library::OnnxRuntime, ExecutionProvider::TensorRt),
            _ => {
                return Err(BackendError::new(format_args!(
                    "provider `{name}` is unknown; known are {KNOWN}"
                )));
            }
        };
        Ok(NamedProvider { name, library, provider })
    }

    fn backend(&self, library: Library) -> Result<&dyn Backend, BackendError> {
        match (library, &self.onnx_runtime) {
            (Library::Rten, _) => Ok(self.rten.as_ref()),
            (Library::OnnxRuntime, Ok(backend)) => Ok(backend.as_ref()),
            (Library::OnnxRuntime, Err(reason)) => {
                Err(BackendError::new(format_args!("there is no ONNX Runtime: {reason}")))
            }
        }
    }

    fn reason(
        &self,
        providers: &[String],
        chosen: &NamedProvider<'_>,
        errors: &[String],
    ) -> String {
        let mut reason = errors.to_vec();
        reason.push(match (providers.is_empty(), errors.is_empty()) {
            (true, _) => "the manifest names no provider".to_owned(),
            (false, true) => format!("`{}` is the first provider in the manifest", chosen.name),
            (false, false) => format!("`{}` is the next provider in the manifest", chosen.name),
        });
        match &self.onnx_runtime {
            Err(missing) if chosen.library == Library::Rten && chosen.name == "cpu" => {
                reason.push(format!("there is no ONNX Runtime: {missing}"));
            }
            _ => {}
        }
        reason.join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::FakeGraph;
    use super::*;

    struct FakeBackend {
        version: &'static str,
        works: &'static [ExecutionProvider],
    }

    impl Backend for FakeBackend {
        fn version(&self) -> String {
            self.version.to_owned()
        }

        fn load(
            &self,
            model: Vec<u8>,
            options: &LoadOptions<'_>,
        ) -> Result<Box<dyn LoadedGraph>, BackendError> {
            assert_eq!(model, b"model");
            if self.works.contains(&options.provider) {
                return Ok(Box::new(FakeGraph));
            }
            Err(BackendError::new(format_args!("no {}", options.provider.name())))
        }
    }

    const CPU: ExecutionProvider = ExecutionProvider::Cpu;

    /// Returns the runtime and the reason, or the error.
    fn chosen(
        library: Option<&'static [ExecutionProvider]>,
        providers: &[&str],
        threads: u32,
    ) -> String {
        let onnx_runtime =
            library.map(|works| FakeBackend { version: "onnxruntime 1.23.2", works });
        let backends = Backends::new(
            Box::new(FakeBackend { version: "rten 0.27.0", works: &[CPU] }),
            onnx_runtime.map(|it| Box::new(it) as Box<dyn Backend>).ok_or("no file".to_owned()),
        );
        let providers: Vec<String> = providers.iter().map(|name| (*name).to_owned()).collect();
        let signature = ModelSignature::default();
        let none = EngineUse::None;
        match backends.load(b"model".to_vec(), &providers, threads, &signature, none) {
            Ok(chosen) => format!("{}: {}", chosen.runtime, chosen.reason),
            Err(error) => format!("error: {error}"),
        }
    }

    #[test]
    fn without_a_named_provider_the_library_is_used_if_there_is_one() {
        assert_eq!(
            chosen(None, &[], 1),
            "rten 0.27.0, cpu, 1 thread: the manifest names no provider; there is no ONNX Runtime: \
             no file"
        );
        assert_eq!(
            chosen(Some(&[CPU]), &[], 2),
            "onnxruntime 1.23.2, cpu, 2 threads: the manifest names no provider"
        );
    }

    #[test]
    fn named_providers_are_tried_in_order_and_their_errors_are_kept() {
        let all = ["tensorrt", "cuda", "cpu"];
        assert_eq!(
            chosen(Some(&[ExecutionProvider::Cuda, CPU]), &all, 1),
            "onnxruntime 1.23.2, cuda, 1 thread: `tensorrt` failed: no tensorrt; `cuda` is the \
             next provider in the manifest"
        );
        let found = chosen(None, &all, 1);
        let start = "rten 0.27.0, cpu, 1 thread: `tensorrt` failed: there is no ONNX Runtime: no \
                     file;";
        assert!(found.starts_with(start), "{found}");
        assert_eq!(
            chosen(Some(&[CPU]), &["rten"], 1),
            "rten 0.27.0, cpu, 1 thread: `rten` is the first provider in the manifest"
        );
    }

    #[test]
    fn a_provider_that_fails_is_never_replaced_silently() {
        assert_eq!(
            chosen(Some(&[CPU]), &["tensorrt", "cuda"], 1),
            "error: `tensorrt` failed: no tensorrt; `cuda` failed: no cuda"
        );
        assert_eq!(
            chosen(None, &["onnxruntime"], 1),
            "error: `onnxruntime` failed: there is no ONNX Runtime: no file"
        );
        assert_eq!(
            chosen(Some(&[CPU]), &["cpu", "gpu"], 1),
            "error: provider `gpu` is unknown; known are cpu, cuda, tensorrt, rten and onnxruntime"
        );
    }
}
