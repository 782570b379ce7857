//! Checks the isolation layers of a lambda's process: `gleaner-shim` sets each one up and tests it.

use gleaner_parts::Parts;
use gleaner_protocol::{Holds, Layer, REQUIRED_HELP};

use super::{Finding, Severity, output_of};

/// Returns a finding for each layer.
pub(super) fn findings(parts: &Parts) -> Vec<Finding> {
    match layers(parts) {
        Ok(layers) => layers.iter().map(finding).collect(),
        Err(why) => {
            vec![Finding::warning("isolation", why, "build it again: cargo build --release")]
        }
    }
}

fn layers(parts: &Parts) -> Result<Vec<Layer>, String> {
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
    match layer.holds {
        Holds::Yes => Finding::ok("isolation", detail),
        Holds::No if layer.prevents_lambdas() => Finding {
            subject: "isolation",
            state: Severity::Error,
            detail: format!("no lambda can run: {detail}"),
            help: Some(REQUIRED_HELP.to_owned()),
        },
        Holds::Partly | Holds::No => Finding {
            subject: "isolation",
            state: Severity::Warning,
            detail,
            help: Some(
                "Python lambdas are isolated by fewer layers; see docs/security.md".to_owned(),
            ),
        },
    }
}
