//! Replays the sample drive with the examples and the recipes of the cookbook, for `demo` and
//! `bless`.

use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::{Clip, Decision, twins_differ};
use gleaner_protocol::{ReplaySummary, Verified};
use gleaner_report::{Decisions, ResultsError, clips};

use crate::checkout::Checkout;
use crate::onnxruntime::with_models;
use crate::steps;

pub(crate) const DRIVE: &str = "examples/data/highway_drive.mcap";

const JOURNAL: &str = "wakes.journal";

/// Folder of the recipes, relative to the checkout.
const COOKBOOK: &str = "examples/cookbook";

/// An example with settings for the gentle braking in the sample drive.
pub(crate) struct Example {
    pub(crate) name: &'static str,
    pub(crate) set: &'static [&'static str],
    /// End of the replayed part of the drive in s; `None` for its end.
    to: Option<&'static str>,
    /// True if its decisions depend only on recent samples, so that a clip alone reproduces them.
    pub(crate) is_stateless: bool,
    /// True if it runs a model, which needs `gleaner-inference`.
    pub(crate) has_models: bool,
}

const fn example(name: &'static str, set: &'static [&'static str]) -> Example {
    Example { name, set, to: None, is_stateless: true, has_models: false }
}

pub(crate) const EXAMPLES: [Example; 4] = [
    example("hello", &["brake_mps2=-1.4"]),
    example("brake-dark", &["brake_mps2=-1.4", "dark_luma=50"]),
    // Its consecutive windows depend on the first sample of the drive.
    Example { is_stateless: false, ..example("imu-fft", &[]) },
    // Some 50 ms for each frame.
    Example {
        to: Some("3"),
        has_models: true,
        ..example("yolo-detector", &["classes=car, truck"])
    },
];

pub(crate) struct TwinReplay {
    pub(crate) summary: ReplaySummary,
    /// Decisions with a trigger or a fault.
    pub(crate) decisions: Vec<Decision>,
    pub(crate) clips: Vec<Clip>,
    lambda: PathBuf,
    out: PathBuf,
}

impl Example {
    /// Replays the Rust and the Python twin, in this order. Results go to
    /// `out/demo/<example>-<kind>/`.
    pub(crate) fn replay(&self, checkout: &Checkout) -> Result<[TwinReplay; 2], Failure> {
        Ok([self.replay_twin(checkout, "rust")?, self.replay_twin(checkout, "python")?])
    }

    /// The folders of both twins, relative to the checkout.
    pub(crate) fn lambdas(&self) -> [PathBuf; 2] {
        ["rust", "python"].map(|language| self.lambda(language))
    }

    fn lambda(&self, language: &str) -> PathBuf {
        Path::new("examples").join(self.name).join(language)
    }

    fn replay_twin(&self, checkout: &Checkout, language: &str) -> Result<TwinReplay, Failure> {
        let kind = if language == "rust" { "wasm" } else { language };
        let lambda = self.lambda(language);
        let settings = self.set.iter().flat_map(|set| ["--set".to_owned(), (*set).to_owned()]);
        let to = self.to.iter().flat_map(|to| ["--to".to_owned(), (*to).to_owned()]);
        replay(checkout, &format!("{}-{kind}", self.name), lambda, settings.chain(to).collect())
    }
}

/// A lambda of the cookbook in one language. The first line of its `expected.txt` is the command
/// that produces the other lines.
pub(crate) struct Recipe {
    name: String,
    /// The first line of `expected.txt`.
    pub(crate) command: String,
}

impl Recipe {
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

    /// Path of `expected.txt`, relative to the checkout.
    pub(crate) fn expected(&self) -> PathBuf {
        Path::new(COOKBOOK).join(&self.name).join("expected.txt")
    }

    /// Runs the command. Results go to `out/demo/cookbook-<name>/`.
    pub(crate) fn replay(&self, checkout: &Checkout) -> Result<TwinReplay, Failure> {
        // The arguments after `gleaner replay DIR DRIVE`.
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
) -> Result<TwinReplay, Failure> {
    let out = Path::new("out/demo").join(name);
    let mut replay = with_models(checkout, "gleaner");
    replay.arg("replay").arg(&lambda).args([DRIVE, "--json"]).args(settings).arg("--out").arg(&out);
    // The folder may be missing, and a journal of an earlier demo is replaced.
    let folder = checkout.path(&out);
    steps::make_folder(&folder)?;
    replay.arg("--journal").arg(out.join(JOURNAL));
    let summary: ReplaySummary = report(&mut replay)?;
    let clips = if summary.recording.clips > 0 { clips(&folder)? } else { Vec::new() };
    Ok(TwinReplay { decisions: decisions(&folder)?, clips, summary, lambda, out })
}

impl TwinReplay {
    /// Repeats every decision of the journal, from the drive.
    pub(crate) fn verify(&self, checkout: &Checkout) -> Result<Verified, Failure> {
        let mut verify = with_models(checkout, "gleaner");
        verify.arg("replay").arg(&self.lambda).args([DRIVE, "--json", "--verify"]);
        verify.arg(self.out.join(JOURNAL));
        report(&mut verify)
    }

    /// Repeats the decisions of a clip, from the clip alone.
    pub(crate) fn verify_clip(
        &self,
        checkout: &Checkout,
        clip: &Clip,
    ) -> Result<Verified, Failure> {
        let mut verify = with_models(checkout, "gleaner");
        verify.args(["verify", "--json"]).arg(self.out.join(&clip.file));
        verify.arg("--lambda").arg(&self.lambda);
        report(&mut verify)
    }

    /// Path of a result file, relative to the checkout.
    pub(crate) fn path(&self, file: &Path) -> String {
        self.out.join(file).display().to_string()
    }
}

fn report<T: serde::de::DeserializeOwned>(
    gleaner: &mut std::process::Command,
) -> Result<T, Failure> {
    let json = steps::output(gleaner, "see the error above; the results up to it are in out/demo")?;
    steps::parsed(&json, "gleaner --json")
}

fn decisions(out: &Path) -> Result<Vec<Decision>, ResultsError> {
    Decisions::open(out)?.collect()
}

/// The first difference between twins, as text; `None` if they agree.
pub(crate) fn difference([a, b]: &[TwinReplay; 2]) -> Option<String> {
    if a.summary.wakes != b.summary.wakes {
        return Some(format!("the number of wakes is {} and {}", a.summary.wakes, b.summary.wakes));
    }
    let held = |twin: &TwinReplay| {
        twin.clips
            .iter()
            .map(|clip| (clip.from_ns, clip.to_ns, clip.topics.clone()))
            .collect::<Vec<_>>()
    };
    if held(a) != held(b) {
        return Some("the contents of the clips".to_owned());
    }
    let (a, b) = (&a.decisions, &b.decisions);
    let differ =
        |(index, (a, b))| twins_differ(a, b).map(|what| format!("decision {}: {what}", index + 1));
    a.iter().zip(b).enumerate().find_map(differ).or_else(|| {
        (a.len() != b.len())
            .then(|| format!("the number of decisions is {} and {}", a.len(), b.len()))
    })
}
