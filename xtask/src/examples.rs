//! The examples on the sample drive: what `demo` shows and `bless` writes down.

use std::path::Path;

use gleaner_cli::results::{Decisions, ResultsError};
use gleaner_protocol::{Decision, Exit, Failure, Summary, twins_differ};

use crate::checkout::Checkout;
use crate::steps;

/// The drive that comes with the checkout.
pub(crate) const DRIVE: &str = "examples/data/highway_drive.mcap";

/// An example, with the values that suit the sample drive: its braking is gentle.
pub(crate) struct Example {
    pub(crate) name: &'static str,
    pub(crate) set: &'static [&'static str],
}

pub(crate) const EXAMPLES: [Example; 2] = [
    Example { name: "hello", set: &["brake_mps2=-1.4"] },
    Example { name: "brake-dark", set: &["brake_mps2=-1.4", "dark_luma=50"] },
];

/// What one twin did.
pub(crate) struct Replayed {
    pub(crate) summary: Summary,
    /// Those with a trigger or a fault.
    pub(crate) decisions: Vec<Decision>,
}

impl Example {
    /// Replays the Rust and the Python twin, in this order. Results go to `out/demo/<example>-<kind>/`.
    pub(crate) fn replay(&self, checkout: &Checkout) -> Result<[Replayed; 2], Failure> {
        Ok([self.replay_twin(checkout, "rust")?, self.replay_twin(checkout, "python")?])
    }

    fn replay_twin(&self, checkout: &Checkout, language: &str) -> Result<Replayed, Failure> {
        let kind = if language == "rust" { "wasm" } else { language };
        let out = Path::new("out/demo").join(format!("{}-{kind}", self.name));
        let mut replay = checkout.command(checkout.program("gleaner"));
        replay.arg("replay").arg(Path::new("examples").join(self.name).join(language)).arg(DRIVE);
        for set in self.set {
            replay.args(["--set", set]);
        }
        replay.arg("--out").arg(&out).arg("--json");
        let json = steps::output(&mut replay, "see the error above; what was decided until then is in out/demo")?;
        let summary = serde_json::from_str(&json)
            .map_err(|error| Failure::caused_by(Exit::Internal, "`gleaner replay --json` gave no summary", &error))?;
        Ok(Replayed { summary, decisions: decisions(&checkout.path(out))? })
    }
}

fn decisions(out: &Path) -> Result<Vec<Decision>, ResultsError> {
    Decisions::open(out)?.collect()
}

/// What differs first between twins, for a person; `None` if they agree.
pub(crate) fn difference([a, b]: &[Replayed; 2]) -> Option<String> {
    if a.summary.wakes != b.summary.wakes {
        return Some(format!("the number of wakes is {} and {}", a.summary.wakes, b.summary.wakes));
    }
    let (a, b) = (&a.decisions, &b.decisions);
    let differ = |(index, (a, b))| twins_differ(a, b).map(|what| format!("decision {}: {what}", index + 1));
    a.iter()
        .zip(b)
        .enumerate()
        .find_map(differ)
        .or_else(|| (a.len() != b.len()).then(|| format!("the number of decisions is {} and {}", a.len(), b.len())))
}
