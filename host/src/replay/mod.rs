//! A built lambda over recorded drives: the very same artifact as on the vehicle, pulled as fast as the machine goes.
//!
//! Time is the drive's. A sample is delivered, the lambda runs if its schedule says so, then the next: nothing is skipped,
//! and nothing depends on how fast the machine is.

mod output;
mod round;

use std::io::Write;
use std::path::PathBuf;

use gleaner_protocol::manifest::{ConfigSet, ConfigValue, Manifest};
use gleaner_protocol::{BuildDir, Exit, Failure, Report};

use crate::input::Remap;
use crate::program::{Load, ReplayArgs};
use output::Output;

/// What to replay, checked.
pub struct Options {
    /// The lambda's folder.
    pub lambda: PathBuf,
    /// Its build, not older than its sources.
    pub build: BuildDir,
    /// The drives, merged by time.
    pub drives: Vec<PathBuf>,
    /// All of `[config]`, with the overrides laid over the defaults.
    pub config: Vec<(String, ConfigValue)>,
    /// Other names for topics of the manifest.
    pub remaps: Vec<Remap>,
    /// Where results are written.
    pub out: PathBuf,
    /// Whether every decision is written.
    pub all: bool,
    /// How often to replay.
    pub repeat: u32,
}

impl Options {
    /// Checks `args` against the build folder and the manifest in it.
    ///
    /// # Errors
    ///
    /// A failure that names the manifest's line, the key or the topic, and the way out.
    pub fn new(args: ReplayArgs) -> Result<(Self, Manifest), Failure> {
        let build = BuildDir::check_fresh(&args.lambda)?;
        let manifest = Manifest::load(build.path())?;
        let config = ConfigSet::resolve(&manifest, &args.set)?;
        for remap in &args.remap {
            if !manifest.inputs.iter().any(|input| input.topic.as_str() == remap.from) {
                let known = manifest.inputs.iter().map(|input| input.topic.as_str()).collect::<Vec<_>>().join("`, `");
                let failure = Failure::new(Exit::Usage, format!("no input has the topic `{}` of --remap", remap.from));
                return Err(failure.with_help(format!("the manifest has `{known}`")));
            }
        }
        let out = args.out.unwrap_or_else(|| args.lambda.join("out"));
        let options = Self {
            lambda: args.lambda,
            build,
            drives: args.drives,
            config,
            remaps: args.remap,
            out,
            all: args.all,
            repeat: args.repeat,
        };
        Ok((options, manifest))
    }
}

/// Replays, writes results to `options.out` and reports to `reports`.
///
/// The exit is [`Exit::DriveDamaged`] if the drive ended in damage (results up to there are kept), else
/// [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
///
/// # Errors
///
/// A failure if the replay cannot start, or results cannot be written.
pub fn run(options: &Options, manifest: &Manifest, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
    let mut last = None;
    for n in 1..=options.repeat {
        let mut output = Output::create(&options.out, options.all)?;
        let summary = round::replay(options, manifest, &mut *load, &mut output, reports)?;
        output.finish(&summary)?;
        if options.repeat > 1 {
            report(reports, &Report::Round(round::report(n, &summary)));
        }
        last = Some(summary);
    }
    let summary = last.expect("at least one round");
    let exit = if summary.damaged.is_some() {
        Exit::DriveDamaged
    } else if summary.faults > 0 {
        Exit::LambdaFaulted
    } else {
        Exit::Ok
    };
    report(reports, &Report::Summary(Box::new(summary)));
    Ok(exit)
}

/// Whoever listens may have gone; the results are in files.
fn report(reports: &mut dyn Write, report: &Report) {
    if let Ok(mut line) = serde_json::to_string(report) {
        line.push('\n');
        let _ = reports.write_all(line.as_bytes());
    }
}
