//! The examples and the recipes of the cookbook on the sample drive: what `demo` shows and `bless`
//! writes down.

use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::{Clip, Decision, twins_differ};
use gleaner_protocol::{ReplaySummary, Verified};
use gleaner_report::{Decisions, ResultsError, clips};

use crate::checkout::Checkout;
use crate::steps;

/// The drive that comes with the checkout.
pub(crate) const DRIVE: &str = "examples/data/highway_drive.mcap";

const JOURNAL: &str = "wakes.journal";

/// Where the recipes are, relative to the checkout.
const COOKBOOK: &str = "examples/cookbook";

/// An example, with the values that suit the sample drive: its braking is gentle.
pub(crate) struct Example {
    pub(crate) name: &'static str,
    pub(crate) set: &'static [&'static str],
    /// Whether it decides by what it looks at in a wake and shortly before, so that a clip alone
    /// tells what it decided.
    pub(crate) forgets: bool,
}

pub(crate) const EXAMPLES: [Example; 3] = [
    Example { name: "hello", set: &["brake_mps2=-1.4"], forgets: true },
    Example { name: "brake-dark", set: &["brake_mps2=-1.4", "dark_luma=50"], forgets: true },
    // Its windows follow each other from the first sample of the drive on.
    Example { name: "imu-fft", set: &[], forgets: false },
];

/// What one twin did.
pub(crate) struct Replayed {
    pub(crate) summary: ReplaySummary,
    /// Those with a trigger or a fault.
    pub(crate) decisions: Vec<Decision>,
    /// Made around its triggers.
    pub(crate) clips: Vec<Clip>,
    lambda: PathBuf,
    out: PathBuf,
}

impl Example {
    /// Replays the Rust and the Python twin, in this order. Results go to
    /// `out/demo/<example>-<kind>/`.
    pub(crate) fn replay(&self, checkout: &Checkout) -> Result<[Replayed; 2], Failure> {
        Ok([self.replay_twin(checkout, "rust")?, self.replay_twin(checkout, "python")?])
    }

    /// The folders of both, relative to the checkout.
    pub(crate) fn lambdas(&self) -> [PathBuf; 2] {
        ["rust", "python"].map(|language| self.lambda(language))
    }

    fn lambda(&self, language: &str) -> PathBuf {
        Path::new("examples").join(self.name).join(language)
    }

    fn replay_twin(&self, checkout: &Checkout, language: &str) -> Result<Replayed, Failure> {
        let kind = if language == "rust" { "wasm" } else { language };
        let lambda = self.lambda(language);
        let settings = self.set.iter().flat_map(|set| ["--set".to_owned(), (*set).to_owned()]);
        replay(checkout, &format!("{}-{kind}", self.name), lambda, settings.collect())
    }
}

/// A lambda of the cookbook: in one language, with an `expected.txt` whose first line is the
/// command that finds the others.
pub(crate) struct Recipe {
    name: String,
    /// That first line.
    pub(crate) command: String,
}

impl Recipe {
    /// All of them.
    pub(crate) fn all(checkout: &Checkout) -> Result<Vec<Recipe>, Failure> {
        let folders = checkout
            .lambdas(&["examples"])
            .into_iter()
            .filter(|lambda| lambda.starts_with(COOKBOOK));
        folders.map(|folder| Recipe::read(checkout, &folder)).collect()
    }

    fn read(checkout: &Checkout, folder: &Path) -> Result<Recipe, Failure> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let begin = format!("gleaner replay {} {DRIVE}", folder.display());
        let file = folder.join("expected.txt");
        let text = fs::read_to_string(checkout.path(&file)).unwrap_or_default();
        match text.lines().next().filter(|line| line.starts_with(&begin)) {
            Some(command) => Ok(Recipe { name, command: command.to_owned() }),
            None => Err(Failure::new(
                Exit::Usage,
                format!("`{}` does not begin with its command", file.display()),
            )
            .with_help(format!(
                "write into its first line: {begin}, and what else the command needs"
            ))),
        }
    }

    /// The file that says what it finds, relative to the checkout.
    pub(crate) fn expected(&self) -> PathBuf {
        Path::new(COOKBOOK).join(&self.name).join("expected.txt")
    }

    /// Does what the command says. Results go to `out/demo/cookbook-<name>/`.
    pub(crate) fn replay(&self, checkout: &Checkout) -> Result<Replayed, Failure> {
        // Behind `gleaner replay DIR DRIVE`.
        let settings = self.command.split_whitespace().skip(4).map(str::to_owned).collect();
        replay(
            checkout,
            &format!("cookbook-{}", self.name),
            Path::new(COOKBOOK).join(&self.name),
            settings,
        )
    }
}

/// Replays a lambda with `settings` over the sample drive. Results go to `out/demo/<name>/`.
fn replay(
    checkout: &Checkout,
    name: &str,
    lambda: PathBuf,
    settings: Vec<String>,
) -> Result<Replayed, Failure> {
    let out = Path::new("out/demo").join(name);
    let mut replay = checkout.command(checkout.program("gleaner"));
    replay
        .arg("replay")
        .arg(&lambda)
        .arg(DRIVE)
        .args(settings)
        .arg("--out")
        .arg(&out)
        .arg("--json");
    // The folder may not be there yet, and a journal of an earlier demo is replaced.
    fs::create_dir_all(checkout.path(&out))
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot make `out/demo`", &error))?;
    replay.arg("--journal").arg(out.join(JOURNAL));
    let summary: ReplaySummary = report(&mut replay)?;
    let folder = checkout.path(&out);
    let clips = if summary.recording.clips > 0 { clips(&folder)? } else { Vec::new() };
    Ok(Replayed { decisions: decisions(&folder)?, clips, summary, lambda, out })
}

impl Replayed {
    /// Makes every decision of the journal again, from the drive.
    pub(crate) fn verify(&self, checkout: &Checkout) -> Result<Verified, Failure> {
        let mut verify = checkout.command(checkout.program("gleaner"));
        verify
            .arg("replay")
            .arg(&self.lambda)
            .arg(DRIVE)
            .arg("--verify")
            .arg(self.out.join(JOURNAL))
            .arg("--json");
        report(&mut verify)
    }

    /// Makes the decisions in a clip again, from the clip alone.
    pub(crate) fn verify_clip(
        &self,
        checkout: &Checkout,
        clip: &Clip,
    ) -> Result<Verified, Failure> {
        let mut verify = checkout.command(checkout.program("gleaner"));
        verify
            .arg("verify")
            .arg(self.out.join(&clip.file))
            .arg("--lambda")
            .arg(&self.lambda)
            .arg("--json");
        report(&mut verify)
    }

    /// A file of its results, as a person would name it.
    pub(crate) fn path(&self, file: &Path) -> String {
        self.out.join(file).display().to_string()
    }
}

/// What `gleaner --json` reports.
fn report<T: serde::de::DeserializeOwned>(
    gleaner: &mut std::process::Command,
) -> Result<T, Failure> {
    let json =
        steps::output(gleaner, "see the error above; what was decided until then is in out/demo")?;
    serde_json::from_str(&json).map_err(|error| {
        Failure::caused_by(Exit::Internal, "`gleaner --json` gave no report", &error)
    })
}

fn decisions(out: &Path) -> Result<Vec<Decision>, ResultsError> {
    Decisions::open(out)?.collect()
}

/// What differs first between twins, for a person; `None` if they agree.
pub(crate) fn difference([a, b]: &[Replayed; 2]) -> Option<String> {
    if a.summary.wakes != b.summary.wakes {
        return Some(format!("the number of wakes is {} and {}", a.summary.wakes, b.summary.wakes));
    }
    let held = |twin: &Replayed| {
        twin.clips
            .iter()
            .map(|clip| (clip.from_ns, clip.to_ns, clip.topics.clone()))
            .collect::<Vec<_>>()
    };
    if held(a) != held(b) {
        return Some("the clips do not hold the same".to_owned());
    }
    let (a, b) = (&a.decisions, &b.decisions);
    let differ =
        |(index, (a, b))| twins_differ(a, b).map(|what| format!("decision {}: {what}", index + 1));
    a.iter().zip(b).enumerate().find_map(differ).or_else(|| {
        (a.len() != b.len())
            .then(|| format!("the number of decisions is {} and {}", a.len(), b.len()))
    })
}
