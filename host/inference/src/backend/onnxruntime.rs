//! Runs models by ONNX Runtime, a library that is loaded at run time from an explicit path.
//!
//! Telemetry, memory arenas, memory patterns and spinning threads are off: a vehicle has other work
//! for its cores, and arenas keep twice the memory.

use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

use gleaner_protocol::inference::{Element, TensorInfo};
use half::f16;
use ort::environment::Environment;
use ort::ep::{self, ExecutionProviderDispatch};
use ort::logging::LogLevel;
use ort::session::{RunOptions, Session, SessionInputValue};
use ort::value::{DynValue, PrimitiveTensorElementType, Tensor, TensorRef};
use tracing::{debug, warn};

use super::elements::{bytes, numbers};
use super::{
    Backend, BackendError, ExecutionProvider, LoadOptions, LoadedGraph, StopSignal, TensorValue,
};

#[derive(Debug)]
pub struct OnnxRuntime {
    environment: Environment,
    version: String,
    /// A line about the libraries, GPU and driver that an engine depends on.
    machine: String,
}

struct OrtGraph {
    session: Session,
    inputs: Vec<TensorInfo>,
    outputs: Vec<TensorInfo>,
}

impl OnnxRuntime {
    /// Opens the library. Call it once, before the sandbox closes. Engines depend on `machine`, a
    /// line about libraries, GPU and driver.
    ///
    /// # Errors
    ///
    /// The reason of the loader, or a library that is too old.
    pub fn open(library: &Path, machine: &str) -> Result<Self, BackendError> {
        let builder = ort::init_from(library).map_err(BackendError::new)?;
        let environment = builder
            .with_name("gleaner")
            .with_telemetry(false)
            .with_logger(Arc::new(|level, _category, _id, _place, message| log(level, message)))
            .build()
            .map_err(BackendError::new)?;
        environment.set_log_level(LogLevel::Warning);
        let version = format!("onnxruntime {}", version_of(library, ort::info()));
        Ok(Self { environment, version, machine: machine.to_owned() })
    }

    fn session(&self, model: &[u8], options: &LoadOptions<'_>) -> ort::Result<Session> {
        let mut builder = Session::builder(&self.environment)?
            .with_intra_threads(options.threads as usize)?
            .with_inter_threads(1)?
            .with_parallel_execution(false)?
            .with_intra_op_spinning(false)?
            .with_inter_op_spinning(false)?
            .with_memory_pattern(false)?
            .with_execution_providers(providers(options.provider))?;
        if let Some(engine) = options.engine {
            let path = engine.to_string_lossy();
            // A model that contains the engine. The keys are those of ONNX Runtime 1.18 and later.
            for (key, value) in [
                ("ep.context_enable", "1"),
                ("ep.context_embed_mode", "1"),
                ("ep.context_file_path", &path),
            ] {
                builder = builder.with_config_entry(key, value)?;
            }
        }
        builder.commit_from_memory(model)
    }
}

/// Returns the providers to register: the one of the model, and the processor for operators that it
/// lacks.
fn providers(provider: ExecutionProvider) -> Vec<ExecutionProviderDispatch> {
    let cpu = ep::CPU::default().with_arena_allocator(false).build();
    let own = match provider {
        ExecutionProvider::Cpu => None,
        ExecutionProvider::Cuda => Some(
            ep::CUDA::default()
                .with_arena_extend_strategy(ep::ArenaExtendStrategy::SameAsRequested)
                .with_conv_algorithm_search(ep::cuda::ConvAlgorithmSearch::Heuristic)
                .build(),
        ),
        ExecutionProvider::TensorRt => Some(ep::TensorRT::default().build()),
    };
    own.into_iter().chain([cpu]).map(ExecutionProviderDispatch::error_on_failure).collect()
}

/// Returns the version: from the name of the file, as in `libonnxruntime.so.1.23.2`, or from the
/// description of the build, which has `git-branch=rel-1.23.2`.
fn version_of(library: &Path, info: &str) -> String {
    let file = library.canonicalize().unwrap_or_else(|_| library.to_owned());
    let file = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let in_name = file.split_once(".so.").map(|(_, version)| version).filter(|it| it.contains('.'));
    let in_info = info.split_once("git-branch=rel-").map(|(_, rest)| rest);
    let in_info = in_info.and_then(|rest| rest.split([',', ' ']).next());
    in_name.or(in_info).unwrap_or("of an unknown version").to_owned()
}

impl Backend for OnnxRuntime {
    fn version(&self) -> String {
        self.version.clone()
    }

    fn engine_runtime(&self) -> String {
        format!("{}; {}", self.version, self.machine)
    }

    fn load(
        &self,
        model: Vec<u8>,
        options: &LoadOptions<'_>,
    ) -> Result<Box<dyn LoadedGraph>, BackendError> {
        let session = self.session(&model, options).map_err(|error| match options.provider {
            ExecutionProvider::Cpu => BackendError::new(error),
            // Most libraries are for the CPU only.
            _ => BackendError::new(format_args!(
                "{error} ({}; ORT_DYLIB_PATH can name another library)",
                self.version
            )),
        })?;
        let signature = options.signature;
        let inputs = signature.inputs.clone();
        let outputs = signature.outputs.iter().map(|output| output.tensor.clone()).collect();
        Ok(Box::new(OrtGraph { session, inputs, outputs }))
    }
}

impl LoadedGraph for OrtGraph {
    fn run(
        &mut self,
        inputs: &[TensorValue],
        stop: &StopSignal,
    ) -> Result<Vec<TensorValue>, BackendError> {
        let values = self.inputs.iter().zip(inputs).map(|(info, input)| {
            Ok((info.name.as_str(), value_of(input).map_err(BackendError::new)?))
        });
        let values = values.collect::<Result<Vec<_>, BackendError>>()?;
        let options = Arc::new(RunOptions::new().map_err(BackendError::new)?);
        let terminated = Arc::clone(&options);
        stop.on_stop(move || {
            // Without it the run goes on to its end.
            let _ = terminated.terminate();
        });
        let results = self.session.run_with_options(values, &options).map_err(BackendError::new)?;
        let found = self.outputs.iter().map(|info| {
            let name = &info.name;
            let missing = || BackendError::new(format_args!("there is no output `{name}`"));
            let value = results.get(name).ok_or_else(missing)?;
            output_of(info, value).map_err(BackendError::new)
        });
        found.collect()
    }
}

fn value_of(input: &TensorValue) -> ort::Result<SessionInputValue<'_>> {
    let shape: Vec<i64> = input.shape.iter().map(|length| i64::from(*length)).collect();
    let data = &input.bytes;
    match input.element {
        Element::Float32 => tensor(shape, numbers::<f32>(data)),
        Element::Float16 => tensor(shape, numbers::<f16>(data)),
        Element::Float64 => tensor(shape, numbers::<f64>(data)),
        Element::Int8 => tensor(shape, numbers::<i8>(data)),
        Element::Int16 => tensor(shape, numbers::<i16>(data)),
        Element::Int32 => tensor(shape, numbers::<i32>(data)),
        Element::Int64 => tensor(shape, numbers::<i64>(data)),
        Element::Uint8 => tensor(shape, numbers::<u8>(data)),
        Element::Boolean => tensor(shape, data.iter().map(|byte| *byte != 0).collect()),
    }
}

fn tensor<'a, T>(shape: Vec<i64>, data: Cow<'a, [T]>) -> ort::Result<SessionInputValue<'a>>
where
    T: PrimitiveTensorElementType + std::fmt::Debug + Clone + 'static,
{
    Ok(match data {
        Cow::Borrowed(data) => TensorRef::from_array_view((shape, data))?.into(),
        Cow::Owned(data) => Tensor::from_array((shape, data))?.into(),
    })
}

fn output_of(info: &TensorInfo, value: &DynValue) -> ort::Result<TensorValue> {
    let (shape, bytes) = match info.element {
        Element::Float32 => extracted(value, bytes::<f32>)?,
        Element::Float16 => extracted(value, bytes::<f16>)?,
        Element::Float64 => extracted(value, bytes::<f64>)?,
        Element::Int8 => extracted(value, bytes::<i8>)?,
        Element::Int16 => extracted(value, bytes::<i16>)?,
        Element::Int32 => extracted(value, bytes::<i32>)?,
        Element::Int64 => extracted(value, bytes::<i64>)?,
        Element::Uint8 => extracted(value, bytes::<u8>)?,
        Element::Boolean => extracted(value, bytes::<bool>)?,
    };
    Ok(TensorValue { element: info.element, shape, bytes })
}

fn extracted<T: PrimitiveTensorElementType>(
    value: &DynValue,
    bytes_of: fn(&[T]) -> Vec<u8>,
) -> ort::Result<(Vec<u32>, Vec<u8>)> {
    let (shape, data) = value.try_extract_tensor::<T>()?;
    // A length that does not fit cannot be of a tensor in memory.
    let shape = shape.iter().map(|length| u32::try_from(*length).unwrap_or(u32::MAX)).collect();
    Ok((shape, bytes_of(data)))
}

fn log(level: LogLevel, message: &str) {
    match level {
        LogLevel::Error | LogLevel::Fatal => warn!(message, "ONNX Runtime"),
        _ => debug!(message, "ONNX Runtime"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_is_that_of_the_file_or_of_the_build() {
        let version = |file: &str, info: &str| version_of(Path::new(file), info);
        let info = "ORT Build Info: git-branch=rel-1.23.2, git-commit-id=1, build type=Release";
        assert_eq!(version("/none/libonnxruntime.so.1.32.0", info), "1.32.0");
        assert_eq!(version("/none/libonnxruntime.so.1", info), "1.23.2");
        assert_eq!(version("/none/libonnxruntime.so", info), "1.23.2");
        assert_eq!(version("/none/libonnxruntime.so", ""), "of an unknown version");
    }
}
