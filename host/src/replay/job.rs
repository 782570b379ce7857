//! A replay, or a comparison with a journal: its check against the build, and its run.

use std::io::Write;
use std::path::Path;

use gleaner_base::{Exit, Failure};
use gleaner_drives::{ReplayError, Unpacked, journals_of};
use gleaner_lambda::manifest::Manifest;
use gleaner_lambda::{BuildDir, OutputLock};
use gleaner_protocol::Report;
use gleaner_sandbox::Paths;

use super::open::{self, DriveError};
use super::options::{Drives, ReplayArgs, ReplayOptions, VerifyArgs};
use super::reports::{self, send};
use super::round::{self, ReplayOutcome, Results};
use super::time_range::RequestedRange;
use super::verify::{self, ReferenceJournal};
use super::{journal_file, worker_loop};
use crate::guest::worker::MessageSender;
use crate::isolation::{code_cache_dir, definition_dirs};
use crate::session_setup::{ConfiguredLambda, LambdaArgs, Load, RESULTS};

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

    /// A comparison of a clip with the part of the journal in it. Fails as [`ReplayJob::replay`].
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

    /// Runs the replay or the comparison, and writes reports to `reports`.
    ///
    /// For a replay, the exit is [`Exit::DriveDamaged`] if the drive is damaged, or
    /// [`Exit::Internal`] if it could not be read in full (results of what was read are kept); else
    /// [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
    ///
    /// # Errors
    ///
    /// A failure if it cannot start, or results cannot be written; of a comparison, the first
    /// difference.
    pub fn run(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        let Self { options, manifest, task } = self;
        match task {
            Task::Replay(results) => replay(&options, &results, &manifest, load, reports),
            Task::Verify(mut reference) => {
                let verified = verify::run(&options, &manifest, &mut reference, load)?;
                send(reports, &Report::Verified(verified));
                Ok(Exit::Ok)
            }
        }
    }

    /// Runs the worker's part: the guest that `load` creates sends the outcome of each wake, and
    /// the rest goes to `reports`.
    ///
    /// # Errors
    ///
    /// A failure if it cannot start. The process that reads the outcomes finds later errors itself.
    pub fn work(self, load: Load<'_>, reports: &MessageSender) -> Result<Exit, Failure> {
        let Self { options, manifest, task } = self;
        match task {
            Task::Replay(results) => {
                worker_loop::run(&options, results.record, &manifest, load, reports)?
            }
            // Over a drive, the schedule decides on the wakes; in a clip, the journal.
            Task::Verify(reference) if reference.clip.is_none() => {
                worker_loop::run(&options, false, &manifest, load, reports)?
            }
            Task::Verify(mut reference) => {
                drop(verify::run(&options, &manifest, &mut reference, load)?)
            }
        }
        Ok(Exit::Ok)
    }
}

fn replay(
    options: &ReplayOptions,
    results: &Results,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &mut dyn Write,
) -> Result<Exit, Failure> {
    let _hold = OutputLock::take(&results.out)?;
    let mut n = 1;
    let ReplayOutcome { summary, broken, incomplete } = loop {
        let drive = match open::open(options) {
            // The caller replays them one by one.
            Err(ReplayError::Separate { drives })
                if results.journal.is_none() && open::are_text(&drives) =>
            {
                send(reports, &Report::Separate { drives });
                return Ok(Exit::Ok);
            }
            drive => drive.map_err(DriveError)?,
        };
        let ended = round::replay(drive, options, results, manifest, &mut *load, reports, n == 1)?;
        if results.repeat > 1 {
            send(reports, &Report::Round(reports::round(n, &ended.summary)));
        }
        if n >= results.repeat {
            break ended;
        }
        n += 1;
    };
    let faulted = if summary.faults > 0 { Exit::LambdaFaulted } else { Exit::Ok };
    let exit = broken.unwrap_or(faulted);
    send(reports, &Report::Summary(Box::new(summary)));
    let Some(error) = incomplete else { return Ok(exit) };
    let failure = Failure::from(error);
    Err(Failure { exit: if exit == Exit::Ok { failure.exit } else { exit }, ..failure })
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
