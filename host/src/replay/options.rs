//! What to do: the arguments as typed, and what they mean once checked against the build.

use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_drives::{Unpacked, journals_of};
use gleaner_jail::Paths;
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::DriveTime;

use super::journal_file;
use super::part::Wanted;
use super::verify::Claim;
use crate::isolation::{code, definitions};
use crate::stage::{Asked, AskedArgs, RESULTS};

/// Arguments of `replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// MCAP files, databases and directories of rosbag2; several are merged by time.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// Replay from this time on: seconds after the drive's start, or since 1970 behind an `@`.
    #[arg(long, value_name = "TIME")]
    pub from: Option<DriveTime>,
    /// Replay until before this time, given likewise.
    #[arg(long, value_name = "TIME")]
    pub to: Option<DriveTime>,
    /// Where the results go; `DIR/out` if not given.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Leave out the clips that the table `record` of the manifest asks for.
    #[arg(long)]
    pub no_record: bool,
    /// Have clips hold these topics of the drive instead of those of the manifest; a `*` stands for
    /// any letters.
    #[arg(long, value_name = "PATTERN", conflicts_with_all = ["no_record", "verify"])]
    pub topics: Vec<String>,
    /// Write a journal of every wake.
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Make every decision of this journal again and compare, instead of writing results.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["from", "to", "out", "all", "no_record", "journal", "repeat"])]
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
    pub drives: Drives,
    /// What is replayed of them.
    pub part: Wanted,
    /// Which topics of the drive its clips hold, if not those of the manifest.
    pub topics: Vec<String>,
    /// The folder for what packed drives hold, if there is one of ours.
    pub unpack_in: Option<PathBuf>,
    /// What packed drives hold, where that is open already.
    pub unpacked: Vec<Unpacked>,
}

/// Drives, as they were named and as they are.
pub struct Drives {
    /// Files and directories.
    pub named: Vec<PathBuf>,
    /// The files, and those of the directories.
    pub files: Vec<PathBuf>,
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
    /// What a replay may open while the lambda runs: drives again in a further pass, the results,
    /// the code that was compiled.
    pub fn paths(&self) -> Paths {
        let Options { asked, drives, unpacked, .. } = &self.options;
        let mut read = definitions();
        read.push(asked.lambda.clone());
        read.extend(asked.vehicle.clone());
        read.extend(drives.named.iter().chain(&drives.files).cloned());
        read.extend(unpacked.iter().filter_map(Unpacked::given_name).map(Path::to_owned));
        read.extend(
            drives
                .files
                .iter()
                .flat_map(|file| journals_of(file))
                .filter(|journal| journal.is_file()),
        );
        if let Task::Verify(claim) = &self.task {
            read.push(claim.path().to_owned());
        }
        read.extend(code(self.manifest.lambda.kind));
        let journal =
            if let Task::Replay(results) = &self.task { results.journal.clone() } else { None };
        Paths {
            read,
            write: self.results().map(Path::to_owned).into_iter().chain(journal).collect(),
        }
    }

    /// Memory that our own part of the process may still take, in bytes: chunks of drives,
    /// unpacked, and of clips.
    pub fn own_memory(&self) -> u64 {
        512 << 20
    }

    /// Makes an empty journal where none is: nothing but what exists can be granted, and nothing
    /// but a file of ours is.
    ///
    /// # Errors
    ///
    /// A failure that names it.
    pub fn make_journal(&self) -> Result<(), Failure> {
        let Task::Replay(Results { journal: Some(path), .. }) = &self.task else { return Ok(()) };
        journal_file::open(path).map(drop)
    }

    /// The folder of the results, where there are some.
    pub fn results(&self) -> Option<&Path> {
        match &self.task {
            Task::Replay(results) => Some(&results.out),
            Task::Verify(_) => None,
        }
    }

    /// A replay, or with `--verify` a comparison with an earlier one, checked against the build and
    /// its manifest.
    ///
    /// # Errors
    ///
    /// A failure that names the manifest's line, the key, the topic or what differs from the
    /// journal, and the way out.
    pub fn replay(args: ReplayArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.asked.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let drives = Drives::find(args.drives)?;
        if let Some(journal) = args.verify {
            let mut claim = Claim::journal(&journal)?;
            let options = claim.options(args.asked, build, &mut manifest, drives)?;
            return Ok(Self { options, manifest, task: Task::Verify(Box::new(claim)) });
        }
        let asked = Asked::new(args.asked, build, &mut manifest)?;
        let (lambda, build) = (&asked.lambda, &asked.build);
        let out = args.out.unwrap_or_else(|| lambda.join("out"));
        if lies_in(&out, build.path()) {
            let message =
                format!("`{}` lies in the build, and would change the lambda", out.display());
            return Err(
                Failure::new(Exit::Usage, message).with_help("choose another folder: --out DIR")
            );
        }
        if let Some(journal) = args.journal.as_deref().filter(|journal| is_result(journal, &out)) {
            let message = format!("`{}` is a file of the results", journal.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("give the journal a name of its own: --journal FILE"));
        }
        if let Some(journal) =
            args.journal.as_deref().filter(|journal| lies_in(journal, build.path()))
        {
            let message =
                format!("`{}` lies in the build, and would change the lambda", journal.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("write the journal elsewhere: --journal FILE"));
        }
        let results = Results {
            out,
            all: args.all,
            record: !args.no_record,
            journal: args.journal,
            repeat: args.repeat,
        };
        let part = Wanted { from: args.from, to: args.to };
        let unpack_in = Some(results.out.clone());
        let options =
            Options { asked, drives, part, topics: args.topics, unpack_in, unpacked: Vec::new() };
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
        let mut claim = Claim::clip(&args.clip, manifest.lambda.name.as_str())?;
        let asked = AskedArgs {
            lambda: args.lambda,
            set: Vec::new(),
            remap: Vec::new(),
            vehicle: args.vehicle,
        };
        let clip = Drives { named: vec![args.clip.clone()], files: vec![args.clip] };
        let options = claim.options(asked, build, &mut manifest, clip)?;
        Ok(Self { options, manifest, task: Task::Verify(Box::new(claim)) })
    }
}

/// Whether `path` is within `folder`, under whatever name. What is not there yet is where the
/// nearest folder is that is.
fn lies_in(path: &Path, folder: &Path) -> bool {
    let Ok(folder) = folder.canonicalize() else { return path.starts_with(folder) };
    let Ok(path) = std::path::absolute(path) else { return false };
    let real = path.ancestors().find_map(|path| path.canonicalize().ok());
    real.is_some_and(|real| real.starts_with(folder))
}

/// Whether `path` is one of the files that a replay writes into `out` anyway.
fn is_result(path: &Path, out: &Path) -> bool {
    if ["clips", "pictures"].iter().any(|folder| path.starts_with(out.join(folder))) {
        return true;
    }
    let is_name = path.file_name().is_some_and(|name| RESULTS.iter().any(|result| name == *result));
    let folder =
        path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let same = |a: &Path, b: &Path| {
        a == b
            || std::fs::canonicalize(a)
                .ok()
                .is_some_and(|a| std::fs::canonicalize(b).ok() == Some(a))
    };
    is_name && same(folder, out)
}
