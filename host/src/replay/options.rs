//! What to replay: the arguments as typed, and what they mean once checked against the build.

use std::path::PathBuf;

use clap::Args;
use gleaner_protocol::manifest::{ConfigSet, ConfigValue, Manifest};
use gleaner_protocol::{BuildDir, Exit, Failure};

use crate::input::Remap;

/// Arguments of `replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    /// The lambda's folder, built by `gleaner build`.
    pub lambda: PathBuf,
    /// MCAP files; several are merged by time.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// A value of the table `config` of the manifest.
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    /// Another name for a topic of the manifest.
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<Remap>,
    /// Where the results go; `DIR/out` if not given.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Replay so many times in this process, each time from the start.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

fn assignment(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE, as in brake_mps2=-1.4")?;
    Ok((key.trim().to_owned(), value.trim().to_owned()))
}

fn remap(text: &str) -> Result<Remap, String> {
    let (from, to) = text.split_once(":=").ok_or("write FROM:=TO, as in /imu/data:=/car/imu")?;
    Ok(Remap { from: from.trim().to_owned(), to: to.trim().to_owned() })
}

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
        if let Some(twice) = given_twice(&args.drives) {
            let failure = Failure::new(Exit::Usage, format!("drive `{}` is given twice", twice.display()));
            return Err(failure.with_help("its samples would count twice; give each file once"));
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

/// A file that is the same as an earlier one, under whatever name.
fn given_twice(drives: &[PathBuf]) -> Option<&PathBuf> {
    let mut seen = std::collections::HashSet::new();
    drives.iter().find(|drive| std::fs::canonicalize(drive).is_ok_and(|path| !seen.insert(path)))
}
