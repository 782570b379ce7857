//! Measures models: a frame's way through `gleaner-inference` against a plain Python program, the
//! memory that several lambdas of one model take, and the effect of a lambda that floods.
//!
//! - `frames`: the frames, in a file. `python_program`: the Python program.
//! - `model_process`: the process of the models. `lambda_path`: a lambda's way through it.
//! - `clients`: several lambdas of one model.

mod clients;
mod frames;
mod lambda_path;
mod model_process;
mod python_program;

use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_pixels::vision::DetectorLayout;
use gleaner_tests::{TempFolder, root};

use crate::measure::{peak_mib, pss_mib};
use frames::FrameFile;
use gleaner_bench::{BenchResults, Series, SeriesGroup, quantile};
use lambda_path::LambdaPath;
use model_process::{BenchModel, ModelProcess, digest};
use python_program::{PythonProgram, PythonResult};

const THREADS: u32 = 1;
/// Requirements for detections, the same for all programs.
const MIN_SCORE: f32 = 0.4;
const MAX_IOU: f32 = 0.5;
const MAX_COUNT: u32 = 100;

/// Runs before those that count.
const WARM_UP: usize = 3;
/// Runs that count.
const FRAMES: usize = 200;

/// The library of ONNX Runtime for `gleaner-inference`.
const LIBRARY: &str = "ORT_DYLIB_PATH";

/// The models of a run.
#[derive(Args, Clone)]
pub struct InferenceOptions {
    /// A further model, with the layout of Ultralytics, such as a YOLO11m; may be repeated.
    #[arg(long, value_name = "FILE")]
    model: Vec<PathBuf>,
}

/// Measures everything.
pub fn measure(quick: bool, options: &InferenceOptions, results: &mut BenchResults) {
    let folder = TempFolder::new();
    let mut frames = FrameFile::create(folder.path());
    let nano = root().join("examples/yolo-detector/rust/models/yolox_nano.onnx");
    let nano = model("YOLOX-nano", DetectorLayout::Yolox, &nano, quick);
    let others = options.model.iter().map(|path| {
        // As long as the program.
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned().leak();
        model(name, DetectorLayout::Ultralytics, path, quick)
    });
    let models: Vec<BenchModel> = [nano].into_iter().chain(others).collect();
    if std::env::var_os(LIBRARY).is_none() {
        let skipped = format!("onnxruntime and cuda are skipped, as {LIBRARY} is not set");
        results.notes.push(skipped);
    }
    for model in &models {
        detector(model, &mut frames, results);
    }
    models.iter().for_each(|model| clients::memory(model, &mut frames, results));
    clients::flood(&models[0], &mut frames, if quick { 20 } else { 200 }, results);
}

fn model(name: &'static str, layout: DetectorLayout, path: &Path, quick: bool) -> BenchModel {
    let file = std::fs::read(path)
        .unwrap_or_else(|error| panic!("cannot read the model `{}`: {error}", path.display()));
    let frames = if quick { 3 } else { FRAMES };
    BenchModel { name, layout, path: path.to_owned(), sha256: digest(&file), frames }
}

#[derive(Default)]
struct DetectorTimes {
    total: Vec<f64>,
    prepare: Vec<f64>,
    session: Vec<f64>,
    boxes: f64,
}

impl DetectorTimes {
    fn add(&mut self, [total_ms, prepare_ms, session_ms]: [f64; 3], boxes: f64) {
        self.total.push(total_ms);
        self.prepare.push(prepare_ms);
        self.session.push(session_ms);
        self.boxes += boxes;
    }

    /// Returns the times of frames, with the median of their parts as details.
    fn series(&self, program: &str, memory: [(&str, f64); 3]) -> Series {
        let overhead: Vec<f64> =
            self.total.iter().zip(&self.session).map(|(total, session)| total - session).collect();
        let ms = [
            ("p50 of the session, ms", &self.session),
            ("p50 without the session, ms", &overhead),
            ("p50 of the conversion, ms", &self.prepare),
        ];
        let ms =
            ms.map(|(name, values)| (name.to_owned(), format!("{:.2}", quantile(values, 0.5))));
        let memory = memory.map(|(name, mib)| (name.to_owned(), format!("{mib:.0}")));
        let boxes = format!("{:.1}", self.boxes / self.total.len() as f64);
        let boxes = ("boxes in a frame".to_owned(), boxes);
        let details = ms.into_iter().chain(memory).chain([boxes]).collect();
        let (name, values) = (program.to_owned(), self.total.clone());
        Series { name, details, values, ..Series::default() }
    }
}

struct MeasuredPath {
    process: ModelProcess,
    path: LambdaPath,
    times: DetectorTimes,
    /// Values of the output for the first frame.
    first: Vec<f32>,
}

/// Measures a model by all programs, which take turns frame by frame.
fn detector(model: &BenchModel, frames: &mut FrameFile, results: &mut BenchResults) {
    let mut notes = Vec::new();
    let mut paths = Vec::new();
    let with_library: &[&str] =
        if std::env::var_os(LIBRARY).is_some() { &["onnxruntime", "cuda"] } else { &[] };
    for provider in ["rten"].iter().chain(with_library) {
        let process = ModelProcess::start(model);
        let client = process.connect(model, provider);
        match LambdaPath::open(client, model.name, model.layout) {
            Ok(path) => {
                let (times, first) = (DetectorTimes::default(), Vec::new());
                paths.push(MeasuredPath { process, path, times, first });
            }
            Err(why) => notes.push(format!("{} by {provider}: skipped: {why}", model.name)),
        }
    }
    let mut python = match PythonProgram::start(model, &frames.path) {
        Ok(python) => Some((python, DetectorTimes::default())),
        Err(why) => {
            notes.push(format!("{} in Python: skipped: {why}", model.name));
            None
        }
    };
    for number in 0..WARM_UP + model.frames {
        let counts = number >= WARM_UP;
        for measured in &mut paths {
            let result = measured.path.detect(frames.frame(number));
            let ms = |time: std::time::Duration| 1e3 * time.as_secs_f64();
            if counts {
                let boxes = result.detections.len() as f64;
                let times = [result.total, result.prepare, result.session].map(ms);
                measured.times.add(times, boxes);
            }
            if number == 0 {
                measured.first = measured.path.values().to_vec();
            }
        }
        if let Some((python, times)) = &mut python {
            let result = python.detect(number);
            if counts {
                let PythonResult { total_ms, prepare_ms, session_ms, boxes } = result;
                times.add([total_ms, prepare_ms, session_ms], boxes);
            }
        }
    }
    let memory = |id: u32, caller: f64| {
        let (peak, steady) = (peak_mib(id), pss_mib(id));
        [("peak memory, MiB", peak), ("PSS, MiB", steady), ("memory of the caller, MiB", caller)]
    };
    let mut group = SeriesGroup {
        name: format!("{}: a frame of 1920x1080 to its boxes", model.name),
        unit: "ms".to_owned(),
        ..SeriesGroup::default()
    };
    for MeasuredPath { process, path, times, .. } in &paths {
        let memory = memory(process.id(), path.buffers_mib());
        let name = format!("gleaner-inference, {}", path.runtime);
        group.series.push(times.series(&name, memory));
    }
    if let Some((python, times)) = &python {
        group.bases = vec![python.runtime.clone()];
        group.series.push(times.series(&python.runtime, memory(python.id(), 0.0)));
    }
    results.groups.push(group);
    if let [one, others @ ..] = &paths[..] {
        notes.extend(others.iter().map(|other| {
            let by = format!("{} and {}", one.path.runtime, other.path.runtime);
            format!("{} by {by}: {}", model.name, difference(&one.first, &other.first))
        }));
    }
    results.notes.append(&mut notes);
}

/// Describes the largest difference between two outputs for one frame. Relative to a number below
/// 1, a difference has no meaning: it is taken as it is.
fn difference(a: &[f32], b: &[f32]) -> String {
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs() / a.abs().max(b.abs()).max(1.0));
    let largest = differences.fold(0.0, |largest: f32, it| if it > largest { it } else { largest });
    let finite = a.iter().chain(b).all(|value| value.is_finite());
    let finite = if finite && a.len() == b.len() { "all finite" } else { "not all finite" };
    format!("outputs differ by {largest:.1e} at most, relatively; {finite}")
}
