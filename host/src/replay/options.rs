//! What to do: the arguments as typed, and what they mean once checked against the build.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_jail::Paths;
use gleaner_protocol::manifest::Manifest;
use gleaner_protocol::{BuildDir, Exit, Failure};

use super::verify::Claim;
use crate::isolation::definitions;
use crate::stage::{Asked, AskedArgs, OutputError, RESULTS};

/// Arguments of `replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// MCAP files; several are merged by time.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// Where the results go; `DIR/out` if not given.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Leave out the clips that the table `record` of the manifest asks for.
    #[arg(long)]
    pub no_record: bool,
    /// Write a journal of every wake.
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Make every decision of this journal again and compare, instead of writing results.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["out", "all", "no_record", "journal", "repeat"])]
    pub verify: Option<PathBuf>,
    /// Replay so many times in this process, each time from the start.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// Arguments of `verify`.
#[derive(Args, Clone, Debug)]
pub struct VerifyArgs {
    /// A clip, with the part of the journal that made it.
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build`.
    #[arg(long, value_name = "DIR")]
    pub lambda: PathBuf,
    /// The configuration of the vehicle; by default, the limits are those of the journal.
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
}

/// Which lambda judges which drives.
pub struct Options {
    /// The lambda.
    pub asked: Asked,
    /// The drives, merged by time.
    pub drives: Vec<PathBuf>,
}

/// What a replay leaves.
pub(super) struct Results {
    /// Where results are written.
    pub(super) out: PathBuf,
    /// Whether every decision is written.
    pub(super) all: bool,
    /// Whether clips are made.
    pub(super) record: bool,
    /// Where the journal is written.
    pub(super) journal: Option<PathBuf>,
    /// How often to replay.
    pub(super) repeat: u32,
}

/// What to do with the decisions.
pub(super) enum Task {
    Replay(Results),
    Verify(Box<Claim>),
}

/// A lambda, its drives, and what to do with its decisions.
pub struct Job {
    /// Which lambda judges which drives.
    pub options: Options,
    /// The lambda's manifest.
    pub manifest: Manifest,
    pub(super) task: Task,
}

impl Job {
    /// What a replay may open while the lambda runs: drives again in a further pass, the results, the code that was compiled.
    pub fn paths(&self) -> Paths {
        let Options { asked, drives } = &self.options;
        let mut read = definitions();
        read.push(asked.lambda.clone());
        read.extend(asked.vehicle.clone());
        read.extend(drives.iter().cloned());
        if let Task::Verify(claim) = &self.task {
            read.push(claim.path().to_owned());
        }
        read.extend(gleaner_protocol::parts::cache_dir().ok());
        let journal = if let Task::Replay(results) = &self.task { results.journal.clone() } else { None };
        Paths { read, write: self.results().map(Path::to_owned).into_iter().chain(journal).collect() }
    }

    /// Memory that our own part of the process may still take, in bytes: chunks of drives, unpacked, and of clips.
    pub fn own_memory(&self) -> u64 {
        512 << 20
    }

    /// Makes an empty journal where none is: nothing but what exists can be granted.
    ///
    /// # Errors
    ///
    /// A failure that names it.
    pub fn make_journal(&self) -> Result<(), Failure> {
        let Task::Replay(Results { journal: Some(path), .. }) = &self.task else { return Ok(()) };
        match File::options().write(true).create_new(true).open(path) {
            Err(source) if source.kind() != ErrorKind::AlreadyExists => {
                Err(OutputError { path: path.clone(), source }.into())
            }
            _ => Ok(()),
        }
    }

    /// The folder of the results, where there are some.
    pub fn results(&self) -> Option<&Path> {
        match &self.task {
            Task::Replay(results) => Some(&results.out),
            Task::Verify(_) => None,
        }
    }

    /// A replay, or with `--verify` a comparison with an earlier one, checked against the build and its manifest.
    ///
    /// # Errors
    ///
    /// A failure that names the manifest's line, the key, the topic or what differs from the journal, and the way out.
    pub fn replay(args: ReplayArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.asked.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        if let Some(twice) = given_twice(&args.drives) {
            let failure = Failure::new(Exit::Usage, format!("drive `{}` is given twice", twice.display()));
            return Err(failure.with_help("its samples would count twice; give each file once"));
        }
        if let Some(journal) = args.verify {
            let claim = Claim::journal(&journal)?;
            let options = claim.options(args.asked, build, &mut manifest, args.drives)?;
            return Ok(Self { options, manifest, task: Task::Verify(Box::new(claim)) });
        }
        let asked = Asked::new(args.asked, build, &mut manifest)?;
        let (lambda, build) = (&asked.lambda, &asked.build);
        let out = args.out.unwrap_or_else(|| lambda.join("out"));
        if let Some(journal) = args.journal.as_deref().filter(|journal| is_result(journal, &out)) {
            let message = format!("`{}` is a file of the results", journal.display());
            return Err(
                Failure::new(Exit::Usage, message).with_help("give the journal a name of its own: --journal FILE")
            );
        }
        if let Some(journal) = args.journal.as_deref().filter(|journal| journal.starts_with(build.path())) {
            let message = format!("`{}` lies in the build, and would change the lambda", journal.display());
            return Err(Failure::new(Exit::Usage, message).with_help("write the journal elsewhere: --journal FILE"));
        }
        let results =
            Results { out, all: args.all, record: !args.no_record, journal: args.journal, repeat: args.repeat };
        let options = Options { asked, drives: args.drives };
        Ok(Self { options, manifest, task: Task::Replay(results) })
    }

    /// A comparison of a clip with the part of the journal in it.
    ///
    /// # Errors
    ///
    /// As [`Job::replay`].
    pub fn verify(args: VerifyArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let claim = Claim::clip(&args.clip, manifest.lambda.name.as_str())?;
        let asked = AskedArgs { lambda: args.lambda, set: Vec::new(), remap: Vec::new(), vehicle: args.vehicle };
        let options = claim.options(asked, build, &mut manifest, vec![args.clip])?;
        Ok(Self { options, manifest, task: Task::Verify(Box::new(claim)) })
    }
}

/// Whether `path` is one of the files that a replay writes into `out` anyway.
fn is_result(path: &Path, out: &Path) -> bool {
    if path.starts_with(out.join("clips")) {
        return true;
    }
    let is_name = path.file_name().is_some_and(|name| RESULTS.iter().any(|result| name == *result));
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let same = |a: &Path, b: &Path| {
        a == b || std::fs::canonicalize(a).ok().is_some_and(|a| std::fs::canonicalize(b).ok() == Some(a))
    };
    is_name && same(folder, out)
}

/// A file that is the same as an earlier one, under whatever name.
fn given_twice(drives: &[PathBuf]) -> Option<&PathBuf> {
    let mut seen = std::collections::HashSet::new();
    drives.iter().find(|drive| std::fs::canonicalize(drive).is_ok_and(|path| !seen.insert(path)))
}
