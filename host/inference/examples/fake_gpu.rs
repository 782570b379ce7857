//! `gleaner-inference` with a backend that pretends to run TensorRT on a GPU, for tests of engines.
//!
//! The variable `GLEANER_FAKE_GPU` has the name of its runtime, and optionally, after a comma, the
//! way in which a build fails.

use std::fs::{self, File};
use std::path::Path;
use std::process::ExitCode;

use gleaner_inference::backend::{
    Backend, BackendError, ExecutionProvider, LoadOptions, LoadedGraph, StopSignal, TensorValue,
};
use gleaner_inference::program::main_with;
use gleaner_protocol::inference::{Element, TensorInfo};

/// The first bytes of its engines.
const ENGINE: &[u8] = b"engine of the fake GPU";

/// A size above that of any engine.
const HUGE: u64 = 513 << 20;

struct FakeGpu {
    runtime: String,
    failure: String,
}

/// A model whose outputs are zeros.
struct Zeros {
    outputs: Vec<TensorInfo>,
}

fn main() -> ExitCode {
    main_with(|_library, _machine| {
        let text = std::env::var("GLEANER_FAKE_GPU").map_err(|error| error.to_string())?;
        let (runtime, failure) = text.split_once(',').unwrap_or((&text, ""));
        Ok(Box::new(FakeGpu { runtime: runtime.to_owned(), failure: failure.to_owned() }))
    })
}

impl FakeGpu {
    fn build(&self, engine: &Path) -> std::io::Result<()> {
        match &*self.failure {
            "dies" => std::process::abort(),
            "hangs" => loop {
                std::thread::park();
            },
            "huge" => File::create(engine)?.set_len(HUGE),
            "link" => std::os::unix::fs::symlink("/etc/passwd", engine),
            "nothing" => Ok(()),
            _ => fs::write(engine, ENGINE),
        }
    }
}

impl Backend for FakeGpu {
    fn version(&self) -> String {
        "fake 1".to_owned()
    }

    fn engine_runtime(&self) -> String {
        self.runtime.clone()
    }

    fn load(
        &self,
        model: Vec<u8>,
        options: &LoadOptions<'_>,
    ) -> Result<Box<dyn LoadedGraph>, BackendError> {
        if options.provider != ExecutionProvider::TensorRt {
            return Err(BackendError::new("there is only a fake GPU"));
        }
        if model.starts_with(ENGINE) && self.failure == "refuses" {
            return Err(BackendError::new("it is of another version"));
        }
        if let Some(engine) = options.engine {
            self.build(engine).map_err(BackendError::new)?;
        }
        let outputs = options.signature.outputs.iter().map(|output| output.tensor.clone());
        Ok(Box::new(Zeros { outputs: outputs.collect() }))
    }
}

impl LoadedGraph for Zeros {
    fn run(
        &mut self,
        _inputs: &[TensorValue],
        _stop: &StopSignal,
    ) -> Result<Vec<TensorValue>, BackendError> {
        let zeros = self.outputs.iter().map(|info| {
            let shape: Vec<u32> = info.shape.iter().map(|length| length.unwrap_or(1)).collect();
            let bytes = Element::bytes_of(info.element, &shape)
                .ok_or_else(|| BackendError::new("it is too large"))?;
            Ok(TensorValue { element: info.element, shape, bytes: vec![0; bytes as usize] })
        });
        zeros.collect()
    }
}
