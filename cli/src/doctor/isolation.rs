//! Checks the isolation layers of a lambda's process: `gleaner-shim` sets each one up and tests it.

use gleaner_base::programs::InstalledPrograms;
use gleaner_protocol::{Holds, Layer};

use super::{Finding, Severity, output_of};

pub(super) fn findings(parts: &InstalledPrograms) -> Vec<Finding> {
    match layers(parts) {
        Ok(layers) => layers.iter().map(finding).collect(),
        Err(why) => {
            vec![Finding::warning("isolation", why, "build it again: cargo build --release")]
        }
    }
}

fn layers(parts: &InstalledPrograms) -> Result<Vec<Layer>, String> {
    let output = output_of(parts, "gleaner-shim", "--layers")?;
    if !output.status.success() {
        return Err(format!(
            "gleaner-shim failed: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        ));
    }
    serde_json::from_slice(&output.stdout)
        .map_err(|error| format!("cannot parse the output of gleaner-shim: {error}"))
}

fn finding(layer: &Layer) -> Finding {
    let detail = format!("{}: {}", layer.name, layer.note);
    let (state, detail) = match layer.holds {
        Holds::Yes => return Finding::ok("isolation", detail),
        Holds::No if layer.prevents_lambdas() => {
            (Severity::Error, format!("no lambda can run: {detail}"))
        }
        Holds::Partly | Holds::No => (Severity::Warning, detail),
    };
    Finding { subject: "isolation", state, detail, help: Some(layer.help().to_owned()) }
}
