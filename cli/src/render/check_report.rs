//! Formats the report of `gleaner check`.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_lambda::manifest::LambdaKind;
use gleaner_protocol::{CheckReport, Need, NeedPlace};
use gleaner_report::format::size;

use super::{Paint, written};

pub(crate) fn check_report(report: &CheckReport, paint: Paint) -> String {
    written(|text| write(text, report, paint))
}

fn write(text: &mut String, report: &CheckReport, paint: Paint) -> fmt::Result {
    let name = format!("{} {}", visible(&report.lambda), visible(&report.version));
    let init = match report.init_ms {
        Some(ms) => paint.green(&format!("loaded, init took {ms:.1} ms")),
        None => paint.yellow("loaded, init not run"),
    };
    // The settings behind a version of wasmtime matter to journals, not to readers.
    let engine = match report.kind {
        LambdaKind::Wasm => report.engine.split(',').next().unwrap_or_default(),
        LambdaKind::Python => &report.engine,
    };
    let engine = engine.split("; model `").next().unwrap_or_default();
    writeln!(text, "{} ({}): {init}", paint.bold(&name), visible(engine))?;
    let models = report.engine.split("; ").filter(|part| part.starts_with("model `"));
    for model in models {
        writeln!(text, "{}", visible(model))?;
    }
    for note in &report.notes {
        writeln!(text, "  {}", paint.yellow(&visible(note)))?;
    }
    for line in &report.log {
        writeln!(text, "  log: {}", visible(line))?;
    }
    for (place, word) in [(NeedPlace::Memory, "memory"), (NeedPlace::Disk, "disk")] {
        let needs: Vec<&Need> = report.needs.iter().filter(|need| need.place == place).collect();
        if needs.is_empty() {
            continue;
        }
        let sum = |preallocated: bool| {
            let bytes = needs
                .iter()
                .filter(|need| need.preallocated == preallocated)
                .filter_map(|need| need.bytes);
            bytes.fold(0, u64::saturating_add)
        };
        let (preallocated, later) = (sum(true), sum(false));
        let max = size(preallocated.saturating_add(later));
        let beyond = if needs.iter().any(|need| need.bytes.is_none()) {
            ", plus items without a limit"
        } else {
            ""
        };
        writeln!(text, "{word}: {} preallocated, up to {max}{beyond}", size(preallocated))?;
        for need in needs {
            let bytes = need.bytes.map_or_else(|| "no limit".to_owned(), size);
            let is_exact = need.preallocated || need.bytes.is_none();
            let bytes = if is_exact { bytes } else { format!("up to {bytes}") };
            writeln!(text, "{bytes:>16}  {}", visible(&need.purpose))?;
        }
    }
    writeln!(
        text,
        "resident memory after loading, with the buffers of the inputs: {}",
        size(report.resident_bytes)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn needs_are_summed_up_by_place_and_preallocation() {
        let need = |purpose: &str, mib: u64, place, preallocated| {
            let bytes = (mib > 0).then_some(mib << 20);
            Need { purpose: purpose.to_owned(), bytes, place, preallocated }
        };
        let found = CheckReport {
            lambda: "dip".to_owned(),
            version: "0.1.0".to_owned(),
            kind: LambdaKind::Wasm,
            engine: "wasmtime 48, fuel, 1".to_owned(),
            init_ms: Some(0.25),
            resident_bytes: 30 << 20,
            needs: vec![
                need("input `imu`", 3, NeedPlace::Memory, true),
                need("preroll", 64, NeedPlace::Memory, false),
                need("model `m`", 4, NeedPlace::Disk, true),
                need("clips", 0, NeedPlace::Disk, false),
            ],
            log: vec!["ready".to_owned()],
            notes: Vec::new(),
        };
        let expected = "dip 0.1.0 (wasmtime 48): loaded, init took 0.2 ms
  log: ready
memory: 3.0 MiB preallocated, up to 67.0 MiB
         3.0 MiB  input `imu`
  up to 64.0 MiB  preroll
disk: 4.0 MiB preallocated, up to 4.0 MiB, plus items without a limit
         4.0 MiB  model `m`
        no limit  clips
resident memory after loading, with the buffers of the inputs: 30.0 MiB
";
        assert_eq!(check_report(&found, Paint::new(false)), expected);
        let noted = CheckReport { init_ms: None, notes: vec!["no \u{1b}type".to_owned()], ..found };
        let text = check_report(&noted, Paint::new(false));
        assert!(text.contains("init not run\n  no \\u{1b}type\n"), "{text}");
    }
}
