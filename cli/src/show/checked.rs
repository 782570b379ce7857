use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_protocol::{Checked, Need, Place};
use gleaner_report::words::size;

use super::Paint;

/// What was found out about a lambda, for a person.
pub(crate) fn checked(checked: &Checked, paint: Paint) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = write_checked(&mut text, checked, paint);
    text
}

fn write_checked(text: &mut String, checked: &Checked, paint: Paint) -> fmt::Result {
    let name = format!("{} {}", visible(&checked.lambda), visible(&checked.version));
    let init = match checked.init_ms {
        Some(ms) => paint.green(&format!("loads, and its init returns after {ms:.1} ms")),
        None => paint.yellow("loads; its init was not run"),
    };
    writeln!(text, "{} ({}): {init}", paint.bold(&name), visible(&checked.engine))?;
    for note in &checked.notes {
        writeln!(text, "  {}", paint.yellow(&visible(note)))?;
    }
    for line in &checked.log {
        writeln!(text, "  log: {}", visible(line))?;
    }
    for (place, word) in [(Place::Memory, "memory"), (Place::Disk, "disk")] {
        let needs: Vec<&Need> = checked.needs.iter().filter(|need| need.place == place).collect();
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
        let most = size(preallocated.saturating_add(later));
        let beyond = if needs.iter().any(|need| need.bytes.is_none()) {
            ", and what has no bound"
        } else {
            ""
        };
        writeln!(text, "{word}: {} from the start, {most} at most{beyond}", size(preallocated))?;
        for need in needs {
            let bytes = need.bytes.map_or_else(|| "no bound".to_owned(), size);
            let at_most = if need.preallocated || need.bytes.is_none() { "" } else { ", at most" };
            writeln!(text, "{bytes:>12}  {}{at_most}", visible(&need.purpose))?;
        }
    }
    writeln!(
        text,
        "its process has {} now, with its rings and before any sample",
        size(checked.resident_bytes)
    )
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::manifest::Kind;

    use super::*;

    #[test]
    fn needs_are_summed_up_by_place_and_by_when_they_are_taken() {
        let need = |purpose: &str, mib: u64, place, preallocated| {
            let bytes = (mib > 0).then_some(mib << 20);
            Need { purpose: purpose.to_owned(), bytes, place, preallocated }
        };
        let found = Checked {
            lambda: "dip".to_owned(),
            version: "0.1.0".to_owned(),
            kind: Kind::Wasm,
            engine: "wasmtime 48".to_owned(),
            init_ms: Some(0.25),
            resident_bytes: 30 << 20,
            needs: vec![
                need("input `imu`", 3, Place::Memory, true),
                need("preroll", 64, Place::Memory, false),
                need("model `m`", 4, Place::Disk, true),
                need("clips", 0, Place::Disk, false),
            ],
            log: vec!["ready".to_owned()],
            notes: Vec::new(),
        };
        let expected = "dip 0.1.0 (wasmtime 48): loads, and its init returns after 0.2 ms
  log: ready
memory: 3.0 MiB from the start, 67.0 MiB at most
     3.0 MiB  input `imu`
    64.0 MiB  preroll, at most
disk: 4.0 MiB from the start, 4.0 MiB at most, and what has no bound
     4.0 MiB  model `m`
    no bound  clips
its process has 30.0 MiB now, with its rings and before any sample
";
        assert_eq!(checked(&found, Paint::new(false)), expected);
        let noted = Checked { init_ms: None, notes: vec!["no \u{1b}type".to_owned()], ..found };
        let text = checked(&noted, Paint::new(false));
        assert!(text.contains("its init was not run\n  no \\u{1b}type\n"), "{text}");
    }
}
