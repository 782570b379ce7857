//! The speed of the machine, measured by a process of its own: nothing here runs WebAssembly.

use std::collections::BTreeSet;
use std::process::Command;
use std::time::Duration;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure};

use crate::bounded_process;

/// Time for the measurement, which takes half a second.
const LIMIT: Duration = Duration::from_secs(60);
/// Part of the loop's speed that code of lambdas is expected to reach: `brake-dark` reached 0.6 of
/// it, 4.3 of 7 units per ns.
const CODE_SHARE: f64 = 0.5;
/// The lines of `/proc/cpuinfo` that name a processor.
const CPU_KEYS: [&str; 4] = ["model name", "CPU implementer", "CPU part", "CPU variant"];

/// Returns a text that changes when the measured speed no longer holds: with the version of this
/// program, and with the processor.
pub(crate) fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let lines = info.lines().filter_map(|line| line.split_once(':'));
    let named = lines.filter(|(key, _)| CPU_KEYS.contains(&key.trim()));
    let parts: BTreeSet<_> = named.map(|(_, value)| value.trim()).collect();
    let parts: Vec<_> = parts.into_iter().collect();
    format!("{} on {}", env!("CARGO_PKG_VERSION"), gleaner_base::visible(&parts.join(", ")))
}

/// Measures the speed of code of lambdas on this machine, in fuel units per second.
pub(crate) fn fuel_per_second() -> Result<f64, Failure> {
    let program = InstalledPrograms::find()?.program("gleaner-compile")?;
    let output =
        bounded_process::output(Command::new(&program).arg("--speed"), LIMIT).map_err(|error| {
            let action = format!("cannot start `{}`", program.display());
            Failure::caused_by(Exit::Internal, action, &error)
        })?;
    let text = output.as_ref().map(|output| String::from_utf8_lossy(&output.stdout));
    let speed = text.and_then(|text| text.trim().parse::<f64>().ok());
    let speed = speed.map(|speed| speed * CODE_SHARE);
    speed.filter(|speed| speed.is_normal() && *speed > 0.0).ok_or_else(|| {
        let mut failure = Failure::new(Exit::Internal, "cannot measure the speed of this machine");
        failure.causes = vec![match &output {
            None => format!("`{}` did not end within {LIMIT:?}", program.display()),
            Some(output) => gleaner_base::excerpt(&String::from_utf8_lossy(&output.stderr)),
        }];
        failure
    })
}
