//! `cargo xtask bless`: writes the current decisions of the examples as the expected ones, and the
//! generated files.

use std::fs;
use std::path::Path;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::GENERATED;
use gleaner_report::format::trigger_lines;

use crate::checkout::Checkout;
use crate::examples::{DRIVE, EXAMPLES, Recipe, TwinReplay, difference};
use crate::setup;
use crate::steps::{self, Steps, cannot};

/// Writes the files that are generated from the manifest's types, `docs/api`, and the bindings of
/// the Rust SDK, then `examples/*/expected.txt` with a line per trigger of the Rust twin, and
/// `examples/cookbook/*/expected.txt`, whose first line is the command. Fails if the twins of an
/// example differ.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    for file in GENERATED {
        let path = checkout.path(Path::new(file.path));
        // A missing file is generated completely.
        let now = fs::read_to_string(&path).unwrap_or_default();
        let text = file.text(&now).map_err(|why| Failure::new(Exit::Usage, why))?;
        write(checkout, Path::new(file.path), text)?;
    }
    let mut steps = Steps::of(setup::STEPS + 3);
    steps.begin("descriptions of the APIs");
    let mut write_descriptions = checkout.cargo();
    write_descriptions.args(["test", "--release", "--lib", "committed_description"]);
    write_descriptions.args(["--package", "gleaner-cloud", "--package", "gleaner-orchestrator"]);
    steps::run(write_descriptions.env("GLEANER_BLESS", "1"), "see the first error above")?;
    steps.begin("bindings of the Rust SDK");
    let mut write_bindings = setup::test_bindings(checkout);
    steps::run(write_bindings.env("GLEANER_BLESS", "1"), "see the first error above")?;
    setup::run(checkout, &mut steps, &checkout.lambdas(&["examples"]))?;
    steps.begin(&format!("expected decisions on {DRIVE}"));
    for example in &EXAMPLES {
        let twins = example.replay(checkout)?;
        if let Some(what) = difference(&twins) {
            let message = format!("the twins of example `{}` differ", example.name);
            let mut failure = Failure::new(Exit::Differs, message);
            failure.causes = vec![what];
            let help = "compare their decisions.jsonl in out/demo, and correct one of the two";
            return Err(failure.with_help(help));
        }
        let [rust, _] = &twins;
        write(
            checkout,
            &Path::new("examples").join(example.name).join("expected.txt"),
            rows(rust),
        )?;
    }
    for recipe in Recipe::all(checkout)? {
        let rows = rows(&recipe.replay(checkout)?);
        write(checkout, &recipe.expected(), format!("{}\n{rows}", recipe.command))?;
    }
    Ok(Exit::Ok)
}

fn rows(run: &TwinReplay) -> String {
    let lines =
        run.decisions.iter().flat_map(|decision| trigger_lines(decision, run.summary.start_ns));
    lines.map(|line| line + "\n").collect()
}

fn write(checkout: &Checkout, file: &Path, text: String) -> Result<(), Failure> {
    fs::write(checkout.path(file), &text).map_err(|error| cannot("write", file, &error))?;
    println!("{}:\n{text}", file.display());
    Ok(())
}
