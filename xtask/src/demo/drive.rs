//! The first part of the demo: the sample drive, replayed.

use std::collections::BTreeMap;

use gleaner_base::{Failure, visible};
use gleaner_lambda::Decision;
use gleaner_report::format::{clip_contents, clip_span, grouped, seconds};

use crate::checkout::Checkout;
use crate::examples::{DRIVE, Example, TwinReplay, difference};

/// Replays the sample drive with both twins of the examples, compares them, and repeats every
/// decision from the journal and from the clips alone. Returns whether the twins agree.
pub(super) fn run(checkout: &Checkout, examples: &[&Example]) -> Result<bool, Failure> {
    let mut rows =
        vec![["example", "kind", "wakes", "wakes/s", "peak MiB", "triggers"].map(str::to_owned)];
    let (mut verdicts, mut verifications) = (Vec::new(), Vec::new());
    let (mut models, mut clips) = (Vec::new(), Vec::new());
    let mut agree = true;
    for example in examples {
        let twins = example.replay(checkout)?;
        rows.extend(twins.iter().map(|twin| row(example.name, twin)));
        for twin in &twins {
            verifications.push(verify(checkout, example, twin)?);
        }
        models.extend(twins[0].summary.models.iter().map(|model| visible(model)));
        clips.extend(twins.first().into_iter().flat_map(clip_lines));
        let difference = difference(&twins);
        agree &= difference.is_none();
        let with = if example.set.is_empty() { "" } else { " with" };
        let settings: String = example.set.iter().map(|set| format!(" --set {set}")).collect();
        verdicts.push(match difference {
            None => {
                format!(
                    "{}{with}{settings}: the Rust and the Python lambda have the same decisions \
                     and clips",
                    example.name
                )
            }
            Some(what) => format!(
                "{}{with}{settings}: the Rust and the Python lambda DIFFER: {what}",
                example.name
            ),
        });
    }
    println!("\n{}", table(&rows));
    for verdict in models.into_iter().chain(verdicts) {
        println!("{verdict}");
    }
    println!("\nclips of the Rust lambdas:");
    for line in clips {
        println!("{line}");
    }
    println!("\nrepeated decisions:");
    for verification in verifications {
        println!("{verification}");
    }
    Ok(agree)
}

pub(super) fn print_files(checkout: &Checkout) {
    println!(
        "\nfiles: out/demo/EXAMPLE-KIND/ with clips/, clips.jsonl, decisions.jsonl, log.jsonl, \
         summary.json, wakes.journal, and report.html"
    );
    let gleaner = checkout.program("gleaner");
    let gleaner = gleaner.strip_prefix(checkout.path("")).unwrap_or(&gleaner).display();
    println!(
        "try next, with another threshold: {gleaner} replay examples/hello/rust {DRIVE} \
         --set brake_mps2=-1.2"
    );
}

/// Formats each clip: file, contents and thumbnail.
fn clip_lines(twin: &TwinReplay) -> Vec<String> {
    let lines = twin.clips.iter().map(|clip| {
        let [from, to] = clip_span(clip).map(|at_ns| seconds(at_ns, twin.summary.start_ns));
        let thumbnail =
            clip.thumbnail.as_ref().map_or("no camera".to_owned(), |path| twin.path(path));
        let short = clip
            .incomplete
            .iter()
            .map(|why| format!("\n    incomplete: {}", visible(why)))
            .collect::<String>();
        format!(
            "  {}\n    {from:.2} to {to:.2} s: {}\n    thumbnail: {thumbnail}{short}",
            twin.path(&clip.file),
            clip_contents(clip)
        )
    });
    lines.collect()
}

/// Verifies the journal, and every clip if the lambda allows that; returns a line with the number
/// of identical decisions.
fn verify(checkout: &Checkout, example: &Example, twin: &TwinReplay) -> Result<String, Failure> {
    let (name, kind) = (example.name, twin.summary.kind.as_str());
    let whole = twin.verify(checkout)?;
    let all =
        format!("  {name}, {kind}: all {} from the journal and the drive", grouped(whole.wakes));
    if !example.is_stateless {
        return Ok(format!("{all}; not from clips alone, since it keeps state from before them"));
    }
    let parts = twin
        .clips
        .iter()
        .map(|clip| twin.verify_clip(checkout, clip))
        .collect::<Result<Vec<_>, _>>()?;
    let (wakes, uncovered) =
        parts.iter().fold((0, 0), |sum, part| (sum.0 + part.wakes, sum.1 + part.uncovered));
    let clips =
        if parts.len() == 1 { "one clip".to_owned() } else { format!("{} clips", parts.len()) };
    let further = match uncovered {
        0 => String::new(),
        _ => format!(" (in {} the lambda had read samples from before)", grouped(uncovered)),
    };
    Ok(format!("{all}; {} from {clips} alone{further}", grouped(wakes.saturating_sub(uncovered))))
}

fn row(name: &str, TwinReplay { summary, decisions, .. }: &TwinReplay) -> [String; 6] {
    [
        name.to_owned(),
        summary.kind.as_str().to_owned(),
        grouped(summary.wakes),
        grouped(summary.wakes_per_s.round() as u64),
        format!("{:.1}", summary.peak_rss_bytes as f64 / (1024.0 * 1024.0)),
        triggers(decisions, summary.start_ns),
    ]
}

/// Formats each label with the times of its triggers: `hard-brake at 4.14, 10.80 s`.
fn triggers(decisions: &[Decision], start_ns: i64) -> String {
    let mut times: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for decision in decisions {
        for trigger in &decision.triggers {
            let time = format!("{:.2}", seconds(decision.at_ns, start_ns));
            times.entry(&trigger.label).or_default().push(time);
        }
    }
    let labels =
        times.iter().map(|(label, times)| format!("{} at {} s", visible(label), times.join(", ")));
    if times.is_empty() { "none".to_owned() } else { labels.collect::<Vec<_>>().join("; ") }
}

/// Formats a table with columns as wide as their widest cell: text left-aligned, numbers
/// right-aligned.
fn table(rows: &[[String; 6]]) -> String {
    let width =
        |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let line = |row: &[String; 6]| {
        let cells = row.iter().enumerate().map(|(column, cell)| match column {
            2..=4 => format!("{cell:>width$}", width = width(column)),
            _ => format!("{cell:<width$}", width = width(column)),
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triggers_are_grouped_by_label() {
        let decision = |at_ns: i64, label: &str| -> Decision {
            let trigger =
                format!(r#"{{"kind":"event","label":"{label}","score":null,"attributes":{{}}}}"#);
            let rest = r#""fault":null,"fuel":null,"run_ns":0"#;
            let woken = r#""cause":"tick","input":null,"topic":null,"writer":null,"seq":null"#;
            serde_json::from_str(&format!(
                r#"{{"at_ns":{at_ns},{woken},"triggers":[{trigger}],{rest}}}"#
            ))
            .unwrap()
        };
        let decisions =
            [(5_136_000_000, "brake"), (6_000_000_000, "dark"), (11_801_000_000, "brake")];
        let decisions = decisions.map(|(at_ns, label)| decision(at_ns, label));
        assert_eq!(triggers(&decisions, 1_000_000_000), "brake at 4.14, 10.80 s; dark at 5.00 s");
        assert_eq!(triggers(&[], 0), "none");
    }
}
