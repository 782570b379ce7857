//! The status as text for Prometheus.

use std::fmt::Write;

use gleaner_protocol::vehicle_api::{Capacity, VehicleStatus};

/// Names, types and meanings of the metrics of a lambda.
const LAMBDA: [(&str, &str, &str); 10] = [
    ("up", "gauge", "1 while the lambda is ready"),
    ("restarts_total", "counter", "Restarts of its revision"),
    ("wakes_total", "counter", "Wakes"),
    ("triggers_total", "counter", "Triggers"),
    ("faults_total", "counter", "Wakes that ended in a fault"),
    ("skipped_total", "counter", "Event samples that did not wake it"),
    ("unwritten_total", "counter", "Decisions and log lines that could not be written"),
    ("resident_bytes", "gauge", "Resident memory of its process"),
    ("cpu_seconds_total", "counter", "CPU time of its process"),
    ("wake_latency_p99_seconds", "gauge", "99th percentile of the wake latency, of a second"),
];

pub(crate) fn text(status: &VehicleStatus) -> String {
    let mut text = String::new();
    let program = &status.orchestrator;
    for (name, kind, meaning, value) in [
        ("generation", "gauge", "Number of the desired state", status.generation as f64),
        ("resident_bytes", "gauge", "Resident memory", program.rss_bytes as f64),
        ("cpu_seconds_total", "counter", "CPU time", program.cpu_s),
        ("events_lost_total", "counter", "Events that are not durable", status.events_lost as f64),
    ] {
        let name = format!("gleaner_orchestrator_{name}");
        let _ = writeln!(text, "# HELP {name} {meaning}\n# TYPE {name} {kind}\n{name} {value}");
    }
    for (index, (name, kind, meaning)) in LAMBDA.iter().enumerate() {
        let name = format!("gleaner_lambda_{name}");
        let _ = writeln!(text, "# HELP {name} {meaning}\n# TYPE {name} {kind}");
        for deployment in &status.deployments {
            let Some(lambda) = &deployment.status else { continue };
            let live = lambda.live.as_deref();
            let count = |count: fn(&gleaner_protocol::LiveStatus) -> u64| live.map(count);
            let is_up = lambda.phase == gleaner_protocol::supervision::LambdaPhase::Running;
            let value = match index {
                0 => Some(f64::from(u8::from(is_up))),
                1 => Some(f64::from(lambda.restarts)),
                2 => count(|it| it.wakes).map(|it| it as f64),
                3 => count(|it| it.triggers).map(|it| it as f64),
                4 => count(|it| it.faults).map(|it| it as f64),
                5 => count(|it| it.skipped).map(|it| it as f64),
                6 => count(|it| it.unwritten).map(|it| it as f64),
                7 => count(|it| it.rss_bytes).map(|it| it as f64),
                8 => live.map(|it| it.cpu_s),
                _ => live.and_then(|it| it.wake_latency).map(|it| it.p99_ns as f64 / 1e9),
            };
            if let Some(value) = value {
                // Ids and names have no character that would need an escape.
                let (id, lambda) = (&deployment.id, &deployment.lambda);
                let _ = writeln!(text, "{name}{{id=\"{id}\",lambda=\"{lambda}\"}} {value}");
            }
        }
    }
    for (name, meaning) in [
        ("asked", "Amount that all wanted lambdas ask for, in the unit of the resource"),
        ("used", "Amount that they use, where it is measured"),
        ("most", "Amount that they may ask for"),
    ] {
        let name = format!("gleaner_capacity_{name}");
        let _ = writeln!(text, "# HELP {name} {meaning}\n# TYPE {name} gauge");
        for Capacity { resource, unit, asked, used, most, .. } in &status.capacity {
            let value = match name.as_str() {
                "gleaner_capacity_asked" => Some(asked),
                "gleaner_capacity_used" => used.as_ref(),
                _ => Some(most),
            };
            if let Some(value) = value {
                let _ = writeln!(text, "{name}{{resource=\"{resource}\",unit=\"{unit}\"}} {value}");
            }
        }
    }
    text
}
