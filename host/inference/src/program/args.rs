//! Parses the command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::Parser;

/// Runs the models of all lambdas. Standard input is the socket of a starter; reports, one JSON
/// object per line, go to standard output.
#[derive(Parser)]
#[command(name = "gleaner-inference", version = gleaner_base::version())]
pub(super) struct Args {
    /// Library of ONNX Runtime. Default, in this order: the file in the environment variable
    /// ORT_DYLIB_PATH; the newest libonnxruntime.so* in the package `onnxruntime` of the
    /// environment of Python that VIRTUAL_ENV names; in /usr/local/lib; in /usr/lib; in their
    /// packages of Python; in the folder of this program. Without one, models run by rten.
    #[arg(long, value_name = "FILE")]
    pub(super) ort_lib: Option<PathBuf>,
    /// Write the engines of models that `tensorrt` loads into this folder; engines that were built
    /// before are not used.
    #[arg(long, value_name = "DIR")]
    pub(super) build_engines: Option<PathBuf>,
    /// Memory that the process may take, in bytes.
    #[arg(long, value_name = "BYTES", default_value_t = 2 << 30)]
    pub(super) memory: u64,
    /// Largest file of a model, in bytes.
    #[arg(long, value_name = "BYTES", default_value_t = 2 << 30)]
    pub(super) model_max: u64,
    /// Longest run of a model that cannot be interrupted, in s; then the process ends.
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds)]
    pub(super) run_max: Duration,
    /// Longest time to load a model, in s; then the process ends. A provider that compiles models
    /// may need minutes.
    #[arg(long, value_name = "SECONDS", default_value = "120", value_parser = seconds)]
    pub(super) load_max: Duration,
    /// The starter tries each load in another process before this one loads the model.
    #[arg(long)]
    pub(super) trials: bool,
    /// Time for which models are loaded and run one at a time, in s.
    #[arg(long, value_name = "SECONDS", default_value_t = 0)]
    pub(super) apart: u64,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().and_then(|it| Duration::try_from_secs_f64(it).ok());
    seconds.filter(|it| !it.is_zero()).ok_or_else(|| "it is not a number above 0".to_owned())
}
