//! The program `gleaner-inference`.
//!
//! - `args`: the command line.
//! - `library`: the search for ONNX Runtime. `gpu`: what its engines depend on.

mod args;
mod gpu;
mod library;

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_protocol::Handover;
use gleaner_protocol::inference::{InferenceReport, InferenceServer};
use gleaner_protocol::process_stats::start::{reports, stop_socket};
use gleaner_protocol::process_stats::{ReportWriter, log};
use gleaner_sandbox::{Paths, inference as sandbox};
use rustix::process::{Signal, set_parent_process_death_signal};
use tracing::warn;

use crate::backend::{Backend, Backends, OnnxRuntime, RtenBackend};
use crate::engine::InferenceEngine;
use crate::engine_error::EngineError;
use crate::loader::LoadLimits;
use crate::memory;
use crate::region::TensorRegion;
use crate::threads::ModelThreads;
use args::Args;

const OWN_THREADS: &str = "/proc/self/task";

pub fn main() -> ExitCode {
    main_with(open)
}

/// Runs the program with the backend that `open` returns, or the reason why there is none. It is
/// called in the sandbox, with the path of ONNX Runtime, and a line about the machine.
pub fn main_with(
    open: impl FnOnce(Option<&Path>, String) -> Result<Box<dyn Backend>, String>,
) -> ExitCode {
    log::init_service();
    match start(&Args::parse(), open) {
        Ok(()) => Exit::Ok.into(),
        Err(failure) => {
            log::failure(&failure);
            failure.exit.into()
        }
    }
}

fn start(
    args: &Args,
    open: impl FnOnce(Option<&Path>, String) -> Result<Box<dyn Backend>, String>,
) -> Result<(), Failure> {
    let internal = |what: &'static str| {
        move |error: io::Error| Failure::caused_by(Exit::Internal, what, &error)
    };
    let mut reports = reports().map_err(internal("cannot set up the report stream"))?;
    // Before all that may take long: the starter ends a process that sends no report.
    let starting = serde_json::json!(InferenceReport::Starting);
    writeln!(reports, "{starting}").map_err(internal("cannot send a report"))?;
    let library = library::find(args.ort_lib.as_deref());
    let named = named_folders(std::env::var_os("LD_LIBRARY_PATH"));
    let machine = library.as_deref().map(|it| gpu::describe(Path::new("/"), it, &named));
    let (mut paths, has_gpu) = paths(library.as_deref(), named);
    // Kept open, as Landlock forgets a folder of /proc that the kernel has forgotten.
    let _own_threads = File::open(OWN_THREADS);
    paths.write.extend(args.build_engines.clone());
    // Before any thread: one that exists already would keep its privileges.
    let layers = sandbox::start(&paths);
    // A starter that dies also closes the control connection.
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(io::Error::from)
        .map_err(internal("cannot watch for the parent process's death"))?;
    let stop = stop_socket().map_err(internal("cannot handle SIGTERM"))?;
    let (control, running) = connections()?;
    // Not without seals: a lambda could take memory away while it is read.
    TensorRegion::create("gleaner-test", 1).map_err(internal("cannot share tensors"))?;
    let onnx_runtime = open(library.as_deref(), machine.unwrap_or_default());
    let layers = sandbox::close(layers, has_gpu).map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot close the sandbox of the models", &error)
    })?;
    let backends = Backends::new(Box::new(RtenBackend), onnx_runtime);
    let Args { model_max, load_max, run_max, .. } = *args;
    let limits = LoadLimits { model_max, load_max, run_max };
    let engines = args.build_engines.clone();
    let threads = ModelThreads::start(backends, limits, engines, running)
        .map_err(internal("cannot start the threads for models"))?;
    // Their stacks, most of them never used, would count.
    log::layers(layers.into_iter().chain([memory::limit(args.memory)]));
    let writer = ReportWriter::start(reports).map_err(internal("cannot start a thread"))?;
    let sender = writer.sender();
    let reports = Box::new(move |report| sender.send(report));
    let apart = Duration::from_secs(args.apart);
    let engine = InferenceEngine::new(threads, reports, args.trials, apart);
    let ended = engine.run(control, Some(&stop));
    writer.end();
    ended.map_err(|error| match error {
        // Another code than that of an internal error: the model is to blame.
        EngineError::Overdue(_) => Failure::new(Exit::LambdaFaulted, error.to_string()).with_help(
            "give the model a shorter deadline with ONNX Runtime, or a smaller input; for \
                 TensorRT, build its engine ahead: gleaner check DIR --build-engines",
        ),
        error => Failure::caused_by(Exit::Internal, "cannot run models", &error),
    })
}

/// Opens ONNX Runtime; without it, returns the reason.
fn open(library: Option<&Path>, machine: String) -> Result<Box<dyn Backend>, String> {
    let library = library.ok_or_else(library::searched)?;
    match OnnxRuntime::open(library, &machine) {
        Ok(backend) => Ok(Box::new(backend)),
        Err(error) => {
            let (path, reason) = (library.display(), error.to_string());
            warn!(library = %path, reason, "ONNX Runtime cannot be used");
            Err(format!("{path}: {reason}"))
        }
    }
}

/// Returns the folders in the value of `LD_LIBRARY_PATH`: images of containers name those of the
/// driver of NVIDIA there.
fn named_folders(variable: Option<OsString>) -> Vec<PathBuf> {
    let folders = variable.iter().flat_map(std::env::split_paths);
    folders.filter(|folder| folder.is_absolute()).collect()
}

/// Returns the files that the process needs: the folder of the library, in which it finds its
/// providers, the folders that are `named` for others, and the devices of GPUs. Also returns
/// whether there are any: then CUDA, which does not start otherwise, may also name its threads.
fn paths(library: Option<&Path>, named: Vec<PathBuf>) -> (Paths, bool) {
    let Some(library) = library.and_then(|path| path.canonicalize().ok()) else {
        return (Paths::default(), false);
    };
    let devices = std::fs::read_dir("/dev").into_iter().flatten().filter_map(Result::ok);
    let is_gpu = |path: &Path| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        ["nvidia", "nvhost", "nvmap", "nvgpu"].iter().any(|prefix| name.starts_with(prefix))
    };
    let read = library.parent().map(Path::to_owned).into_iter().chain(named).collect();
    let mut write: Vec<_> = devices.map(|entry| entry.path()).filter(|path| is_gpu(path)).collect();
    let has_gpu = !write.is_empty();
    write.extend(has_gpu.then(|| OWN_THREADS.into()));
    (Paths { read, write }, has_gpu)
}

/// Receives the control connection and the file for notes over standard input, the socket of the
/// starter.
fn connections() -> Result<(InferenceServer, Option<File>), Failure> {
    let failed = |error: gleaner_protocol::link::LinkError| {
        Failure::from(error).with_help("start it with `gleaner run LAMBDA`")
    };
    let mut handover = Handover::receive(rustix::stdio::stdin()).map_err(failed)?;
    let control = handover.take_control().map(InferenceServer::new).map_err(failed)?;
    Ok((control, handover.running.take().map(File::from)))
}
