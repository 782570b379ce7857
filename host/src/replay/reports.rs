//! Reports of replays and inspections, one JSON text in each line.

use std::io::Write;

use gleaner_protocol::process_stats::usage;
use gleaner_protocol::{ReplaySummary, Report, Round};

/// Writes a report. Errors are ignored: the reader may have ended, and the results are in files.
pub(super) fn send(reports: &mut dyn Write, report: &Report) {
    if let Ok(mut line) = serde_json::to_string(report) {
        line.push('\n');
        let _ = reports.write_all(line.as_bytes());
    }
}

pub(super) fn round(n: u32, summary: &ReplaySummary) -> Round {
    Round {
        n,
        wakes: summary.wakes,
        faults: summary.faults,
        wall_s: summary.wall_s,
        wakes_per_s: summary.wakes_per_s,
        rss_bytes: usage::resident(),
    }
}
