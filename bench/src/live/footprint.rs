//! Measures the memory of a runtime: its own pages plus its share of shared ones (PSS).

use gleaner_tests::LambdaCopy;
use gleaner_tests::live::{RunningProgram, descendants};

use super::{play_all, start, stop};
use crate::measure::{Figure, Twin};

/// Measures a single runtime, which shares its pages with no other, with minimal memory for
/// samples.
pub(super) fn figures(seconds: u32, figures: &mut Vec<Figure>) {
    for kind in [Twin::Rust, Twin::Python] {
        let lambda = LambdaCopy::of(&format!("bench/lambdas/imu/{}", kind.folder()), |manifest| {
            assert!(manifest.contains("depth = 512"), "the depth has changed");
            manifest.replace("depth = 512", "depth = 1")
        });
        let started = vec![start(lambda.path(), &["--no-record"])];
        let duration = seconds.to_string();
        play_all(
            &started,
            &[vec!["--imu", "100", "--wait", "1", "--duration", &duration]],
            &mut Vec::new(),
        );
        let pss = started.iter().map(|(started, _)| megabytes(started)).collect::<Vec<_>>();
        stop(started);
        let name = format!("one runtime with DDS, without slots, {kind}: PSS");
        figures.push(match kind {
            Twin::Rust => Figure::at_most(&name, "MB", 20.0, &pss),
            Twin::Python => Figure::without_goal(&name, "MB", &pss),
        });
    }
}

/// PSS of the process in which the lambda of `started` runs, in MB; NaN where the system does not
/// provide it.
pub(super) fn megabytes(started: &RunningProgram) -> f64 {
    let file = |pid: u32, name: &str| {
        std::fs::read_to_string(format!("/proc/{pid}/{name}")).unwrap_or_default()
    };
    // The only other process below the shim is the runtime.
    let mut runtimes = descendants(started.pid(), "")
        .into_iter()
        .filter(|pid| file(*pid, "comm").trim() != "gleaner-shim");
    let rollup = runtimes.next().map(|pid| file(pid, "smaps_rollup")).unwrap_or_default();
    let line = rollup.lines().find_map(|line| line.strip_prefix("Pss:"));
    let kib = line
        .and_then(|line| line.trim().strip_suffix(" kB"))
        .and_then(|kib| kib.trim().parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib * 1024.0 / 1e6)
}
