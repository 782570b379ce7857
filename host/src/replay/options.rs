//! Arguments of replays and comparisons, and their check against the build.

use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_drives::{Unpacked, journals_of};
use gleaner_jail::Paths;
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::{DriveTime, PASSES_INFERENCE};

use super::journal_file;
use super::time_range::RequestedRange;
use super::verify::ReferenceJournal;
use crate::isolation::{code_cache_dir, definition_dirs};
use crate::session_setup::{ConfiguredLambda, LambdaArgs, RESULTS};

/// Arguments of `replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    pub lambda_args: LambdaArgs,
    /// MCAP files, databases and directories of rosbag2. Separate drives are reported, and not
    /// replayed.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives.
    #[arg(long)]
    pub merge: bool,
    /// Replay from this time on: seconds after the drive's start, or since 1970 after an `@`.
    #[arg(long, value_name = "TIME")]
    pub from: Option<DriveTime>,
    /// Replay until before this time, in the same format.
    #[arg(long, value_name = "TIME")]
    pub to: Option<DriveTime>,
    /// Folder of the results; `DIR/out` if not given.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Write no clips, even if the manifest has a table `record`.
    #[arg(long)]
    pub no_record: bool,
    /// Record these topics of the drive in clips, instead of those of the manifest; a `*` stands
    /// for any letters.
    #[arg(long, value_name = "PATTERN", conflicts_with_all = ["no_record", "verify"])]
    pub topics: Vec<String>,
    /// Write a journal of every wake.
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Reproduce every decision of this journal and compare, instead of writing results.
    #[arg(long, value_name = "FILE", 
        conflicts_with_all = ["from", "to", "out", "all", "no_record", "journal", "repeat"])]
    pub verify: Option<PathBuf>,
    /// Number of replays in this process, each from the start.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// Arguments of `verify`.
#[derive(Args, Clone, Debug)]
pub struct VerifyArgs {
    /// A clip, which contains its part of the journal.
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build`.
    #[arg(long, value_name = "DIR")]
    pub lambda: PathBuf,
    /// The configuration of the vehicle; by default, the limits are those of the journal.
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Standard input is a socket of the starter, which passes the connection to gleaner-inference.
    #[arg(long = PASSES_INFERENCE, hide = true)]
    pub starter_passes_inference: bool,
}

pub struct ReplayOptions {
    pub lambda: ConfiguredLambda,
    /// The drives, merged by time.
    pub drives: Drives,
    /// Set if drives that overlap in time may have a topic in common.
    pub merge: bool,
    pub range: RequestedRange,
    /// Patterns of the topics that clips hold; empty for those of the manifest.
    pub topics: Vec<String>,
    /// The folder for the contents of packed drives, if this process may write to one.
    pub unpack_in: Option<PathBuf>,
    /// Contents of packed drives that are open already.
    pub unpacked: Vec<Unpacked>,
}

/// Drives: the paths that the user named, and their files.
pub struct Drives {
    /// Files and directories.
    pub named: Vec<PathBuf>,
    /// The named files, and those in the named directories.
    pub files: Vec<PathBuf>,
}

pub(super) struct Results {
    pub(super) out: PathBuf,
    /// Set if every decision is written.
    pub(super) all: bool,
    /// Set if clips are written.
    pub(super) record: bool,
    pub(super) journal: Option<PathBuf>,
    pub(super) repeat: u32,
}

/// The use of the decisions: written, or compared with a journal.
pub(super) enum Task {
    Replay(Results),
    Verify(Box<ReferenceJournal>),
}

/// A replay, or a comparison with a journal.
pub struct ReplayJob {
    pub options: ReplayOptions,
    pub manifest: Manifest,
    pub(super) task: Task,
}

impl ReplayJob {
    /// Paths that may be opened while the lambda runs: drives again in a further pass, the results,
    /// the compiled code.
    pub fn paths(&self) -> Paths {
        let ReplayOptions { lambda, drives, unpacked, .. } = &self.options;
        let mut read = definition_dirs();
        read.push(lambda.folder.clone());
        read.extend(lambda.vehicle.clone());
        read.extend(drives.named.iter().chain(&drives.files).cloned());
        read.extend(unpacked.iter().filter_map(Unpacked::given_name).map(Path::to_owned));
        read.extend(
            drives
                .files
                .iter()
                .flat_map(|file| journals_of(file))
                .filter(|journal| journal.is_file()),
        );
        if let Task::Verify(reference) = &self.task {
            read.push(reference.path().to_owned());
        }
        read.extend(code_cache_dir(self.manifest.lambda.kind));
        let journal =
            if let Task::Replay(results) = &self.task { results.journal.clone() } else { None };
        Paths {
            read,
            write: self.results().map(Path::to_owned).into_iter().chain(journal).collect(),
        }
    }

    /// Memory that Gleaner's own code may still allocate, in bytes: unpacked chunks of drives, and
    /// chunks of clips.
    pub fn own_memory(&self) -> u64 {
        512 << 20
    }

    /// Creates an empty journal if there is none: the sandbox can only grant access to an existing
    /// file.
    ///
    /// # Errors
    ///
    /// A failure that names it.
    pub fn make_journal(&self) -> Result<(), Failure> {
        let Task::Replay(Results { journal: Some(path), .. }) = &self.task else { return Ok(()) };
        journal_file::open(path).map(drop)
    }

    /// The folder of the results; `None` for a comparison.
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
    /// A failure that names the manifest's line, the key, the topic or the difference from the
    /// journal, and the way out.
    pub fn replay(args: ReplayArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.lambda_args.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let drives = Drives::find(args.drives)?;
        if let Some(journal) = args.verify {
            let mut reference = ReferenceJournal::journal(&journal)?;
            let options = reference.options(args.lambda_args, build, &mut manifest, drives)?;
            return Ok(Self { options, manifest, task: Task::Verify(Box::new(reference)) });
        }
        let lambda = ConfiguredLambda::new(args.lambda_args, build, &mut manifest)?;
        let (folder, build) = (&lambda.folder, &lambda.build);
        let out = args.out.unwrap_or_else(|| folder.join("out"));
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
        let range = RequestedRange { from: args.from, to: args.to };
        let unpack_in = Some(results.out.clone());
        let options = ReplayOptions {
            lambda,
            drives,
            merge: args.merge,
            range,
            topics: args.topics,
            unpack_in,
            unpacked: Vec::new(),
        };
        Ok(Self { options, manifest, task: Task::Replay(results) })
    }

    /// A comparison of a clip with the part of the journal in it.
    ///
    /// # Errors
    ///
    /// As [`ReplayJob::replay`].
    pub fn verify(args: VerifyArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let mut reference = ReferenceJournal::clip(&args.clip, manifest.lambda.name.as_str())?;
        let lambda = LambdaArgs {
            lambda: args.lambda,
            set: Vec::new(),
            remap: Vec::new(),
            vehicle: args.vehicle,
            starter_passes_inference: args.starter_passes_inference,
        };
        let clip = Drives { named: vec![args.clip.clone()], files: vec![args.clip] };
        let options = reference.options(lambda, build, &mut manifest, clip)?;
        Ok(Self { options, manifest, task: Task::Verify(Box::new(reference)) })
    }
}

/// Returns whether `path` is within `folder`, after links are resolved. A path that does not exist
/// yet counts as being in its nearest existing ancestor.
fn lies_in(path: &Path, folder: &Path) -> bool {
    let Ok(folder) = folder.canonicalize() else { return path.starts_with(folder) };
    let Ok(path) = std::path::absolute(path) else { return false };
    let real = path.ancestors().find_map(|path| path.canonicalize().ok());
    real.is_some_and(|real| real.starts_with(folder))
}

/// Returns whether `path` is one of the files that a replay writes into `out`.
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
