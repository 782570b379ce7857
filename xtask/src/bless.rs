//! `cargo xtask bless`: what the examples decide today becomes what they are expected to decide.

use std::fs;

use gleaner_cli::results::trigger_lines;
use gleaner_protocol::{Exit, Failure};

use crate::checkout::Checkout;
use crate::examples::{DRIVE, EXAMPLES, difference};
use crate::setup;
use crate::steps::Steps;

/// Writes `examples/*/expected.txt`, a line per trigger of the Rust twin. Twins that differ write nothing.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(setup::STEPS + 1);
    setup::run(checkout, &mut steps, &["examples"])?;
    steps.begin(&format!("expected decisions on {DRIVE}"));
    for example in &EXAMPLES {
        let twins = example.replay(checkout)?;
        if let Some(what) = difference(&twins) {
            let mut failure = Failure::new(Exit::Differs, format!("the twins of example `{}` differ", example.name));
            failure.causes = vec![what];
            return Err(failure.with_help("compare their decisions.jsonl in out/demo, and correct one of the two"));
        }
        let [rust, _] = &twins;
        let lines = rust.decisions.iter().flat_map(|decision| trigger_lines(decision, rust.summary.start_ns));
        let text: String = lines.map(|line| line + "\n").collect();
        let file = format!("examples/{}/expected.txt", example.name);
        fs::write(checkout.path(&file), &text)
            .map_err(|error| Failure::caused_by(Exit::Internal, format!("cannot write `{file}`"), &error))?;
        println!("{file}:\n{text}");
    }
    Ok(Exit::Ok)
}
