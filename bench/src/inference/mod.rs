//! Measures models: a frame's way through `gleaner-inference` against a plain Python program, the
//! memory that several lambdas of one model take, and the effect of a lambda that floods.
//!
//! - `yolo_graph`: graphs of the shape of YOLO11. `graph_writer`: their nodes and weights.
//! - `frames`: the frames, in a file. `python_program`: the Python program.
//! - `model_process`: the process of the models. `lambda_path`: a lambda's way through it.
//! - `clients`: several lambdas of one model.

mod clients;
mod frames;
mod graph_writer;
mod lambda_path;
mod model_process;
#[path = "../../../host/inference/tests/suite/onnx.rs"]
mod onnx;
mod python_program;
mod yolo_graph;

use gleaner_tests::{TempFolder, root};
use gleaner_vision::DetectorLayout;

use crate::measure::quantile;
use frames::FrameFile;
use lambda_path::LambdaPath;
use model_process::{BenchModel, ModelProcess, digest, peak_mib, pss_mib};
use python_program::{PythonProgram, PythonResult};

pub use yolo_graph::{GraphScale, yolo_shaped};

/// Threads of one run.
const THREADS: u32 = 1;
/// Requirements for detections, the same for all programs.
const MIN_SCORE: f32 = 0.4;
const MAX_IOU: f32 = 0.5;
const MAX_COUNT: u32 = 100;

/// Runs before those that count.
const WARM_UP: usize = 3;

/// The library of ONNX Runtime for `gleaner-inference`.
const LIBRARY: &str = "ORT_DYLIB_PATH";

/// Measures everything, and prints tables in Markdown.
pub fn measure(quick: bool) {
    let folder = TempFolder::new();
    let mut frames = FrameFile::create(folder.path());
    let models = models(&folder, quick);
    if std::env::var_os(LIBRARY).is_none() {
        println!("skipped: onnxruntime and cuda in gleaner-inference, as {LIBRARY} is not set\n");
    }
    println!(
        "| model | program | frames | frame p50, ms | p95, ms | session p50, ms | p95, ms \
         | frame minus session p50, ms | p95, ms | of it conversion p50, ms | peak memory, MiB | of the caller, MiB \
         | steady (PSS), MiB | boxes |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    );
    let notes: Vec<String> = models.iter().flat_map(|model| detector(model, &mut frames)).collect();
    println!();
    notes.iter().for_each(|note| println!("- {note}"));
    let [nano, _, large] = &models[..] else { return };
    clients::memory(large, &mut frames);
    clients::flood(nano, &mut frames, if quick { 20 } else { 200 });
}

fn models(folder: &TempFolder, quick: bool) -> Vec<BenchModel> {
    let model = |name, layout, path: std::path::PathBuf, frames| {
        let sha256 = digest(&std::fs::read(&path).expect("the model exists"));
        BenchModel { name, layout, path, sha256, frames: if quick { 3 } else { frames } }
    };
    let shaped = |scale, name: &'static str, frames| {
        let (file, parameters) = yolo_shaped(scale);
        let path = folder.path().join(format!("{name}.onnx"));
        std::fs::write(&path, &file).expect("the disk has room");
        println!("{name}: {:.2} million parameters", parameters as f64 / 1e6);
        model(name, DetectorLayout::Ultralytics, path, frames)
    };
    let nano = root().join("examples/yolo-detector/rust/models/yolox_nano.onnx");
    vec![
        model("YOLOX-nano", DetectorLayout::Yolox, nano, 200),
        shaped(GraphScale::N, "YOLO11n-shaped", 100),
        shaped(GraphScale::M, "YOLO11m-shaped", 40),
    ]
}

/// Times of one program, in ms.
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

    fn print(&self, model: &str, program: &str, [peak, caller, steady]: [f64; 3]) {
        let overhead: Vec<f64> =
            self.total.iter().zip(&self.session).map(|(total, session)| total - session).collect();
        let two = |values: &[f64]| {
            format!("{:.2} | {:.2}", quantile(values, 0.5), quantile(values, 0.95))
        };
        let (frames, boxes) = (self.total.len(), self.boxes / self.total.len() as f64);
        println!(
            "| {model} | {program} | {frames} | {} | {} | {} | {:.2} | {peak:.0} | {caller:.0} \
             | {steady:.0} | {boxes:.1} |",
            two(&self.total),
            two(&self.session),
            two(&overhead),
            quantile(&self.prepare, 0.5)
        );
    }
}

/// A way through `gleaner-inference` that is measured.
struct MeasuredPath {
    process: ModelProcess,
    path: LambdaPath,
    times: DetectorTimes,
    /// Values of the output for the first frame.
    first: Vec<f32>,
}

/// Measures a model by all programs, which take turns frame by frame. Returns notes.
fn detector(model: &BenchModel, frames: &mut FrameFile) -> Vec<String> {
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
    for MeasuredPath { process, path, times, .. } in &paths {
        let memory = [peak_mib(process.id()), path.buffers_mib(), pss_mib(process.id())];
        times.print(model.name, &format!("gleaner-inference, {}", path.runtime), memory);
    }
    if let Some((python, times)) = &python {
        let memory = [peak_mib(python.id()), 0.0, pss_mib(python.id())];
        times.print(model.name, &python.runtime, memory);
    }
    if let [one, others @ ..] = &paths[..] {
        notes.extend(others.iter().map(|other| {
            let by = format!("{} and {}", one.path.runtime, other.path.runtime);
            format!("{} by {by}: {}", model.name, difference(&one.first, &other.first))
        }));
    }
    notes
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
