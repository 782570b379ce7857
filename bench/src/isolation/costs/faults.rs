//! Price of a fault, and of the wake after it, which starts the lambda again: the lambda of the
//! attack tests faults in every third wake, in a replay, or live where a deadline ends it.

use std::path::Path;

use gleaner_bench::{BenchResults, Series, SeriesGroup};
use gleaner_lambda::{Decision, FaultKind};
use gleaner_tests::live::{decisions, run_all};
use gleaner_tests::{LambdaCopy, TempFolder, replay, sample_drive};

use super::live::until_all;
use crate::measure::Twin;

/// A fault in a replay: its row, the kind of lambda, the attack, and the expected fault.
const REPLAYED: [(&str, Twin, &str, FaultKind); 3] = [
    ("wasm: trap", Twin::Rust, "abort", FaultKind::Trap),
    ("wasm: 5,000,000 units of fuel", Twin::Rust, "endless", FaultKind::Fuel),
    // There is no such attack.
    ("Python: exception", Twin::Python, "no_such_attack", FaultKind::Exception),
];
/// Faults by a deadline.
const LIVE: [(&str, Twin); 2] =
    [("wasm: deadline of 20 ms", Twin::Rust), ("Python: deadline of 20 ms", Twin::Python)];

pub(super) fn measure(quick: bool, results: &mut BenchResults) {
    eprintln!("faults");
    let mut measured: Vec<_> = REPLAYED
        .into_iter()
        .map(|(row, twin, attack, kind)| (row, replayed(quick, twin, attack), kind))
        .collect();
    measured.extend(
        LIVE.into_iter()
            .zip(live(if quick { 1 } else { 21 }))
            .map(|((row, _), decisions)| (row, decisions, FaultKind::Deadline)),
    );
    let (mut faulted, mut next) = (Vec::new(), Vec::new());
    for (row, decisions, kind) in &measured {
        let pairs = decisions.array_windows().filter(|[decision, _]| {
            decision.fault.as_ref().is_some_and(|fault| fault.kind == *kind)
        });
        let ms: Vec<[f64; 2]> =
            pairs.map(|pair| [&pair[0], &pair[1]].map(|it| it.run_ns as f64 / 1e6)).collect();
        assert!(!ms.is_empty(), "{row}: no such fault");
        let series = |at: usize| Series {
            name: (*row).to_owned(),
            values: ms.iter().map(|pair| pair[at]).collect(),
            ..Series::default()
        };
        faulted.push(series(0));
        next.push(series(1));
    }
    for (name, series) in [
        ("A wake that ends in a fault", faulted),
        ("The wake after a fault, which starts the lambda again", next),
    ] {
        results.groups.push(SeriesGroup {
            name: name.to_owned(),
            unit: "ms".to_owned(),
            bases: Vec::new(),
            series,
        });
    }
}

fn attacker(twin: Twin, attack: &str, name: &str, changes: &[(&str, &str)]) -> LambdaCopy {
    let folder = format!("tests/lambdas/attack/{}", twin.folder());
    LambdaCopy::changed_and_named(&folder, name, |manifest| {
        let attacks = manifest.replace("default = \"none\"", &format!("default = \"{attack}\""));
        assert_ne!(attacks, manifest, "the configuration has changed");
        changes.iter().fold(attacks, |manifest, (from, to)| manifest.replace(from, to))
    })
}

fn replayed(quick: bool, twin: Twin, attack: &str) -> Vec<Decision> {
    let lambda = attacker(twin, attack, "attack", &[]);
    let seconds = if quick { "1" } else { "12" };
    replay(lambda.path(), &[sample_drive()], &["--all", "--no-record", "--to", seconds]).decisions
}

/// Returns the decisions of endless loops that a deadline ends, until each has had more than
/// `faults` of them: the last one may have no wake after it.
fn live(faults: u64) -> [Vec<Decision>; 2] {
    let copies = LIVE.map(|(_, twin)| {
        let limits = [
            (
                "deadline = \"5s\"\nfuel = 5_000_000",
                "deadline = \"20ms\"\nfuel = 1_000_000_000_000",
            ),
            ("period = \"20ms\"", "period = \"100ms\""),
        ];
        attacker(twin, "endless", twin.folder(), &limits)
    });
    let folders: Vec<&Path> = copies.iter().map(LambdaCopy::path).collect();
    let (out, drive) = (TempFolder::new(), sample_drive());
    let drive = drive.to_str().expect("a plain name");
    let started = run_all(&folders, out.path(), &["--no-record", "--all", "--drive", drive]);
    until_all(&started, "faults by deadlines", LIVE.len(), |live| live.faults > faults);
    started.interrupt();
    LIVE.map(|(_, twin)| decisions(&out.path().join(twin.folder())))
}
