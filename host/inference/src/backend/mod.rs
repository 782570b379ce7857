//! Libraries that run models, behind two traits: a [`Backend`] loads a graph, and a
//! [`LoadedGraph`] runs it.
//!
//! - `choice`: tries the providers of the manifest in order.
//! - `tensorrt`: loads a model with an engine that was built before, or builds one.
//! - `rten`: in this program. `onnxruntime`: a library that is loaded at run time.
//! - `elements`: conversions between bytes and numbers.

mod choice;
mod elements;
mod onnxruntime;
mod rten;
mod tensorrt;

use std::fmt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use gleaner_protocol::inference::Element;

use crate::inspect::ModelSignature;

pub use self::rten::RtenBackend;
pub use choice::{Backends, ChosenGraph};
pub use onnxruntime::OnnxRuntime;
pub use tensorrt::EngineUse;

/// A device and the code for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecutionProvider {
    Cpu,
    Cuda,
    /// NVIDIA GPUs, with code generated for the model.
    TensorRt,
}

impl ExecutionProvider {
    /// Returns its name in manifests and messages.
    pub const fn name(self) -> &'static str {
        match self {
            ExecutionProvider::Cpu => "cpu",
            ExecutionProvider::Cuda => "cuda",
            ExecutionProvider::TensorRt => "tensorrt",
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub struct LoadOptions<'a> {
    pub provider: ExecutionProvider,
    pub threads: u32,
    /// Inputs and outputs, from the file.
    pub signature: &'a ModelSignature,
    /// File to write the engine to, if TensorRT builds one.
    pub engine: Option<&'a Path>,
}

/// A library that runs models.
pub trait Backend: Send + Sync {
    /// Returns its name and version.
    fn version(&self) -> String;

    /// Returns one line about everything that an engine of TensorRT depends on.
    fn engine_runtime(&self) -> String {
        self.version()
    }

    /// Loads a model whose file was checked, or an engine that this backend has written.
    ///
    /// # Errors
    ///
    /// The reason of the library, or the missing provider.
    fn load(
        &self,
        model: Vec<u8>,
        options: &LoadOptions<'_>,
    ) -> Result<Box<dyn LoadedGraph>, BackendError>;
}

/// A loaded model. It runs one request at a time.
pub trait LoadedGraph: Send {
    /// Runs the model with its inputs, in the order of the signature; returns its outputs, in the
    /// order of the signature. A backend that can be interrupted ends at `stop`.
    ///
    /// # Errors
    ///
    /// The reason of the library, or a value that it cannot represent.
    fn run(
        &mut self,
        inputs: &[TensorValue],
        stop: &StopSignal,
    ) -> Result<Vec<TensorValue>, BackendError>;
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorValue {
    pub element: Element,
    pub shape: Vec<u32>,
    /// The elements, little-endian, in row-major order. Bytes of booleans are 0 or 1.
    pub bytes: Vec<u8>,
}

/// The reason why a backend cannot load or run a model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct BackendError(String);

impl BackendError {
    pub fn new(reason: impl fmt::Display) -> BackendError {
        BackendError(reason.to_string())
    }
}

type StopAction = Box<dyn FnOnce() + Send>;

/// A request to end a run, from another thread.
#[derive(Default)]
pub struct StopSignal {
    is_stopped: AtomicBool,
    action: Mutex<Option<StopAction>>,
}

impl StopSignal {
    /// Requests the end of the run. Never waits. Returns whether a backend was notified by this
    /// request; it is only once.
    pub fn stop(&self) -> bool {
        self.is_stopped.store(true, Ordering::SeqCst);
        let action = self.action.lock().unwrap_or_else(PoisonError::into_inner).take();
        action.map(|action| action()).is_some()
    }

    pub fn is_stopped(&self) -> bool {
        self.is_stopped.load(Ordering::SeqCst)
    }

    /// Sets the action of the backend that ends the run. It is called at once if the end was
    /// requested already.
    pub fn on_stop(&self, action: impl FnOnce() + Send + 'static) {
        *self.action.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(action));
        if self.is_stopped() {
            self.stop();
        }
    }
}

impl fmt::Debug for StopSignal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StopSignal").field("is_stopped", &self.is_stopped()).finish()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    /// A model without outputs.
    pub(super) struct FakeGraph;

    impl LoadedGraph for FakeGraph {
        fn run(
            &mut self,
            _inputs: &[TensorValue],
            _stop: &StopSignal,
        ) -> Result<Vec<TensorValue>, BackendError> {
            Ok(Vec::new())
        }
    }

    #[test]
    fn a_run_is_stopped_once_whichever_comes_first() {
        for stops_first in [true, false] {
            let (signal, count) = (StopSignal::default(), Arc::new(Mutex::new(0)));
            if stops_first {
                assert!(!signal.stop());
            }
            let counted = Arc::clone(&count);
            signal.on_stop(move || *counted.lock().unwrap() += 1);
            assert_eq!(signal.stop(), !stops_first);
            assert_eq!((*count.lock().unwrap(), signal.is_stopped()), (1, true));
        }
    }
}
