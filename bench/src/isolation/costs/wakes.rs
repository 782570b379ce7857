//! Time and CPU per wake of the same lambda, run in each way over the same recorded input.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use gleaner_bench::{BenchResults, Series, SeriesGroup};
use gleaner_lambda::{Decision, twins_differ};
use gleaner_test_support::random::XorShift64;
use gleaner_tests::drive::{TopicMessages, of_topics};
use gleaner_tests::{LambdaCopy, TempFolder};
use imu_fft::road::Road;

use super::drives::{self, CAMERA, IMU};
use super::sides::{WakeSide, WakeTurn};
use crate::measure::{Twin, shuffled};
use crate::native_rules::FFT_WINDOW_S;
use crate::rtt::Workload;

/// Wakes without a spectrum that are kept of a turn: all of them would be most of the results.
const OTHER_WAKES: usize = 1_000;
/// The part of a drive that is replayed to know what all but the wakes takes.
const BEGIN: [&str; 2] = ["--to", "0.05"];

struct RecordedWorkload {
    name: &'static str,
    drive: PathBuf,
    lambdas: [LambdaCopy; 2],
    sides: &'static [WakeSide],
    /// True if its wakes take more of the CPU than starts vary.
    has_cpu: bool,
    /// Names of the kinds of its wakes, and the one of each wake.
    kinds: &'static [&'static str],
    kind: fn(&[Decision]) -> Vec<usize>,
    _folder: TempFolder,
}

/// Values of a way to run it.
#[derive(Default)]
struct SideValues {
    /// Times of wakes by their kind, in us.
    wakes: Vec<Vec<f64>>,
    /// CPU time per wake of each turn, in us.
    cpu: Vec<f64>,
}

/// Measures all workloads, in an order by `seed`.
pub(super) fn measure(quick: bool, seed: u64, results: &mut BenchResults) {
    let mut random = XorShift64(seed.max(1));
    let turns = if quick { 1 } else { 15 };
    let mut cpu = Vec::new();
    for workload in [RecordedWorkload::imu(quick), RecordedWorkload::camera(quick)] {
        eprintln!("{}: time and CPU per wake", workload.name);
        let values = workload.measure(turns, &mut random);
        for (index, kind) in workload.kinds.iter().enumerate() {
            let name = format!("{}, {kind}: time per wake", workload.name);
            let group = group(name, workload.sides, &values, |side| &side.wakes[index]);
            results.groups.push(group);
        }
        if workload.has_cpu {
            let name = format!("{}: CPU per wake of a replay", workload.name);
            cpu.push(group(name, workload.sides, &values, |side| &side.cpu));
        }
    }
    results.groups.append(&mut cpu);
}

fn group(
    name: String,
    sides: &[WakeSide],
    values: &[SideValues],
    of: impl Fn(&SideValues) -> &Vec<f64>,
) -> SeriesGroup {
    let series = sides.iter().zip(values).map(|(side, values)| Series {
        name: side.name().to_owned(),
        values: of(values).clone(),
        ..Series::default()
    });
    SeriesGroup {
        name,
        unit: "us".to_owned(),
        bases: vec![WakeSide::NATIVE.name().to_owned()],
        series: series.filter(|series| !series.values.is_empty()).collect(),
    }
}

impl RecordedWorkload {
    /// `examples/imu-fft` on the IMU of the sample drive at 100 Hz.
    fn imu(quick: bool) -> Self {
        let folder = TempFolder::new();
        let mut imu = TopicMessages { topic: IMU.to_owned(), ..TopicMessages::sample_imu() };
        let rounds = if quick { 1 } else { 3 };
        let once = imu.messages.clone();
        imu.messages.clear();
        for round in 0..rounds {
            let after = round * 40_100_000_000;
            imu.messages.extend(once.iter().map(|(at_ns, cdr)| (at_ns + after, cdr.clone())));
        }
        Self {
            name: "IMU, FFT",
            drive: of_topics(&folder, &[imu]),
            lambdas: [Twin::Rust, Twin::Python].map(|kind| Workload::ImuFft.lambda(kind)),
            // Two of them take most of a quick run to compile.
            sides: if quick { &WakeSide::FEWER } else { &WakeSide::ALL },
            has_cpu: true,
            kinds: &["a wake with a spectrum of 128 samples", "another wake"],
            kind: has_no_spectrum,
            _folder: folder,
        }
    }

    /// `examples/brake-dark` on raw frames of 1080p; it computes the luma of each, by the host.
    fn camera(quick: bool) -> Self {
        let folder = TempFolder::new();
        let frames = if quick { 5 } else { 30 };
        Self {
            name: "1080p, Brake + Dark",
            drive: drives::with_frames(&folder, [IMU, CAMERA], 60, frames),
            lambdas: [Twin::Rust, Twin::Python].map(|kind| Workload::Brake1080.lambda(kind)),
            sides: &WakeSide::ALL,
            has_cpu: false,
            kinds: &["a wake with a mean luma by the host"],
            kind: |decisions| vec![0; decisions.len()],
            _folder: folder,
        }
    }

    fn lambda(&self, side: WakeSide) -> &Path {
        self.lambdas[usize::from(side.twin() == Twin::Python)].path()
    }

    fn measure(&self, turns: usize, random: &mut XorShift64) -> Vec<SideValues> {
        let mut values: BTreeMap<usize, SideValues> = BTreeMap::new();
        let mut expected: Option<Vec<Decision>> = None;
        for _ in 0..turns {
            for index in shuffled(self.sides.len(), random) {
                let side = self.sides[index];
                let turn = side.replay(self.lambda(side), &self.drive, &[]);
                let expected = expected.get_or_insert_with(|| turn.decisions.clone());
                assert_eq!(expected.len(), turn.decisions.len(), "{}: {}", self.name, side.name());
                for (expected, decision) in expected.iter().zip(&turn.decisions) {
                    assert_eq!(twins_differ(expected, decision), None, "{}", side.name());
                }
                let values = values.entry(index).or_default();
                values.add(self, &turn);
                if self.has_cpu && side.has_own_cpu() {
                    let begin = side.replay(self.lambda(side), &self.drive, &BEGIN);
                    let wakes = turn.decisions.len() - begin.decisions.len();
                    values.cpu.push((turn.cpu_us - begin.cpu_us) / wakes as f64);
                }
            }
        }
        values.into_values().collect()
    }
}

impl SideValues {
    fn add(&mut self, workload: &RecordedWorkload, turn: &WakeTurn) {
        let mut wakes = vec![Vec::new(); workload.kinds.len()];
        for (decision, kind) in turn.decisions.iter().zip((workload.kind)(&turn.decisions)) {
            wakes[kind].push(decision.run_ns as f64 / 1e3);
        }
        self.wakes.resize(wakes.len(), Vec::new());
        for (kind, wakes) in wakes.iter().enumerate() {
            let kept = if kind == 0 { wakes.len() } else { OTHER_WAKES.min(wakes.len()) };
            self.wakes[kind].extend(&wakes[..kept]);
        }
    }
}

/// Returns 0 for each wake of `examples/imu-fft` with a spectrum, and 1 for the others.
fn has_no_spectrum(decisions: &[Decision]) -> Vec<usize> {
    let mut road = Road::new(FFT_WINDOW_S);
    let has_none = |decision: &Decision| {
        let window = road.note(decision.at_ns).expect("the lambda had the same stamps");
        usize::from(window.is_none())
    };
    decisions.iter().map(has_none).collect()
}
