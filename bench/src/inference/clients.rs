//! Several lambdas of one model: the memory of the process, and the calls of one lambda beside
//! another that floods.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use gleaner_bench::{BenchResults, Figure, Series, SeriesGroup, quantile};

use super::frames::FrameFile;
use super::lambda_path::LambdaPath;
use super::model_process::{BenchModel, ModelProcess};
use crate::measure::{peak_mib, pss_mib};

/// Time between two calls of the patient lambda.
const PERIOD: Duration = Duration::from_millis(100);

/// Name of the series without a lambda beside it.
const ALONE: &str = "alone";

/// Deadline of the calls of the patient lambda. The other one has an earlier deadline, and so comes
/// first wherever that is allowed.
const PATIENT: Duration = Duration::from_secs(30);
const SOON: Duration = Duration::from_secs(10);

/// Measures the memory of the process with 1, 2 and 8 lambdas of one model.
pub(super) fn memory(model: &BenchModel, frames: &mut FrameFile, results: &mut BenchResults) {
    let process = ModelProcess::start(model);
    let mut paths = Vec::new();
    for count in [1, 2, 8] {
        while paths.len() < count {
            let client = process.connect(model, "rten");
            let opened = LambdaPath::open(client, model.name, model.layout);
            let mut path = opened.expect("rten loads the model");
            // Each has another frame than the one before.
            path.detect(frames.frame(paths.len()));
            paths.push(path);
        }
        let (pss, peak) = (pss_mib(process.id()), peak_mib(process.id()));
        for (what, mib) in [("PSS", pss), ("peak memory", peak)] {
            let name = format!("{count} lambdas of {}, by rten: {what}", model.name);
            results.figures.push(Figure::without_goal(&name, "MiB", &[mib]));
        }
    }
}

/// Measures the calls of a patient lambda alone, and beside one that calls all the time.
pub(super) fn flood(
    model: &BenchModel,
    frames: &mut FrameFile,
    calls: u32,
    results: &mut BenchResults,
) {
    let period = PERIOD.as_millis();
    let name = format!("a call of {} each {period} ms, by rten", model.name);
    let bases = vec![ALONE.to_owned()];
    let mut group = SeriesGroup { name, unit: "ms".to_owned(), bases, series: Vec::new() };
    let process = ModelProcess::start(model);
    let [mut patient, mut other] = [(); 2].map(|()| {
        let client = process.connect(model, "rten");
        let mut path =
            LambdaPath::open(client, model.name, model.layout).expect("rten loads the model");
        path.prepare(frames.frame(0));
        path
    });
    let (ends, count) = (AtomicBool::new(false), AtomicU32::new(0));
    group.series.push(patient_calls(&mut patient, calls, ALONE, &count));
    std::thread::scope(|scope| {
        let (ends, count) = (&ends, &count);
        scope.spawn(move || {
            while !ends.load(Ordering::Relaxed) {
                // Its numbers begin behind those of the patient lambda.
                let number = count.fetch_add(1, Ordering::Relaxed);
                other.mark(number | 1 << 31);
                other.run(Some(SOON));
            }
        });
        let beside = "beside a lambda that calls all the time";
        group.series.push(patient_calls(&mut patient, calls, beside, count));
        ends.store(true, Ordering::Relaxed);
    });
    results.groups.push(group);
}

fn patient_calls(patient: &mut LambdaPath, calls: u32, name: &str, others: &AtomicU32) -> Series {
    let (mut times, mut runs) = (Vec::new(), Vec::new());
    let others_before = others.load(Ordering::Relaxed);
    // The first call after a pause does not count.
    for number in 0..=calls {
        let began = Instant::now();
        patient.mark(number << 1 | u32::from(name != ALONE));
        let started = Instant::now();
        let (_, session) = patient.run(Some(PATIENT));
        if number > 0 {
            times.push(1e3 * started.elapsed().as_secs_f64());
            runs.push(1e3 * session.as_secs_f64());
        }
        std::thread::sleep(PERIOD.saturating_sub(began.elapsed()));
    }
    let count = others.load(Ordering::Relaxed) - others_before;
    let runs = format!("{:.1}", quantile(&runs, 0.5));
    let details = [
        ("p50 of the run, ms".to_owned(), runs),
        ("calls of the other".to_owned(), count.to_string()),
    ];
    let (name, details) = (name.to_owned(), details.into());
    Series { name, details, values: times, ..Series::default() }
}
