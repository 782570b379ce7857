//! `cargo xtask demo`: the main job, end to end.

use gleaner_cli::results::seconds;
use gleaner_protocol::{Exit, Failure};

use crate::checkout::Checkout;
use crate::examples::{DRIVE, EXAMPLES, Replayed, difference};
use crate::setup;
use crate::steps::Steps;

/// Replays the sample drive through both twins of every example, and compares them.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 1);
    setup::run(checkout, &mut steps)?;
    steps.begin(&format!("replay of {DRIVE}"));
    let mut rows = vec![["example", "kind", "wakes", "wakes/s", "peak MiB", "triggers at"].map(str::to_owned)];
    let mut verdicts = Vec::new();
    let mut agree = true;
    for example in &EXAMPLES {
        let twins = example.replay(checkout)?;
        rows.extend(twins.iter().map(|twin| row(example.name, twin)));
        let difference = difference(&twins);
        agree &= difference.is_none();
        verdicts.push(match difference {
            None => format!("{}: twins agree", example.name),
            Some(what) => format!("{}: TWINS DIFFER: {what}", example.name),
        });
    }
    println!("\n{}", table(&rows));
    for verdict in verdicts {
        println!("{verdict}");
    }
    println!("files: out/demo/EXAMPLE-KIND/ with decisions.jsonl, log.jsonl and summary.json");
    Ok(if agree { Exit::Ok } else { Exit::Differs })
}

fn row(name: &str, Replayed { summary, decisions }: &Replayed) -> [String; 6] {
    let triggering = decisions.iter().filter(|decision| !decision.triggers.is_empty());
    let times: Vec<_> =
        triggering.map(|decision| format!("{:.2} s", seconds(decision.at_ns, summary.start_ns))).collect();
    [
        name.to_owned(),
        summary.kind.as_str().to_owned(),
        summary.wakes.to_string(),
        format!("{:.0}", summary.wakes_per_s),
        format!("{:.1}", summary.peak_rss_bytes as f64 / (1024.0 * 1024.0)),
        if times.is_empty() { "none".to_owned() } else { times.join(", ") },
    ]
}

/// Columns as wide as their widest cell: words to the left, numbers to the right.
fn table(rows: &[[String; 6]]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
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
    fn a_table_has_words_to_the_left_and_numbers_to_the_right() {
        let rows = [["example", "kind", "wakes", "w/s", "MiB", "at"], ["a", "python", "10", "9999", "1.0", "none"]];
        let rows = rows.map(|row| row.map(str::to_owned));
        assert_eq!(
            table(&rows),
            "example  kind    wakes   w/s  MiB  at\n\
             a        python     10  9999  1.0  none\n"
        );
    }
}
