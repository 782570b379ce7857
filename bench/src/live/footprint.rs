//! What memory a runtime is to blame for: its own pages, and its part of those that it shares with
//! others (PSS).

use gleaner_tests::Copy;
use gleaner_tests::live::{Started, below};

use super::{ended, played, start};
use crate::measure::{Figure, Kind};

/// A runtime alone, that is without others to share its pages with, and with next to no memory for
/// samples.
pub(super) fn figures(seconds: u32, figures: &mut Vec<Figure>) {
    for kind in [Kind::Rust, Kind::Python] {
        let lambda = Copy::of(&format!("bench/lambdas/imu/{}", kind.folder()), |manifest| {
            assert!(manifest.contains("depth = 512"), "it has another depth");
            manifest.replace("depth = 512", "depth = 1")
        });
        let started = vec![start(lambda.path(), &["--no-record"])];
        let duration = seconds.to_string();
        played(
            &started,
            &[vec!["--imu", "100", "--wait", "1", "--duration", &duration]],
            &mut Vec::new(),
        );
        let pss = started.iter().map(|(started, _)| megabytes(started)).collect::<Vec<_>>();
        ended(started);
        let name = format!("one runtime with DDS, without slots, {kind}: PSS");
        figures.push(match kind {
            Kind::Rust => Figure::at_most(&name, "MB", 20.0, &pss),
            Kind::Python => Figure::told(&name, "MB", &pss),
        });
    }
}

/// PSS of the process in which the lambda of `started` runs, in MB; no number where the system does
/// not tell.
pub(super) fn megabytes(started: &Started) -> f64 {
    let file = |pid: u32, name: &str| {
        std::fs::read_to_string(format!("/proc/{pid}/{name}")).unwrap_or_default()
    };
    // Below the shim there is nobody else.
    let mut runtimes = below(started.pid(), "")
        .into_iter()
        .filter(|pid| file(*pid, "comm").trim() != "gleaner-shim");
    let rollup = runtimes.next().map(|pid| file(pid, "smaps_rollup")).unwrap_or_default();
    let line = rollup.lines().find_map(|line| line.strip_prefix("Pss:"));
    let kib = line
        .and_then(|line| line.trim().strip_suffix(" kB"))
        .and_then(|kib| kib.trim().parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib * 1024.0 / 1e6)
}
