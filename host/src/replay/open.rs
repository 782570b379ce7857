//! Opens drives, and turns their errors into failures with an exit code and help.

use std::path::PathBuf;

use gleaner_base::{Exit, Explain, Failure};
use gleaner_drives as replay;
use gleaner_drives::{Replay, ReplayError, files_of};
use gleaner_journal::TimeRange;
use gleaner_messages::Sources;

use super::options::{Drives, ReplayOptions};
use crate::isolation::definition_dirs;

impl Drives {
    pub(super) fn find(named: Vec<PathBuf>) -> Result<Self, Failure> {
        let files = files_of(&named).map_err(DriveError)?;
        // A file counts as the same under any name.
        let mut seen = std::collections::HashSet::new();
        match files
            .iter()
            .find(|file| std::fs::canonicalize(file).is_ok_and(|path| !seen.insert(path)))
        {
            Some(twice) => Err(DriveError(ReplayError::Twice { path: twice.clone() }).into()),
            None => Ok(Self { named, files }),
        }
    }
}

/// Opens the drives, merged by time, and returns the range of them that is replayed.
pub(super) fn open_drives(options: &ReplayOptions) -> Result<(Replay, TimeRange), Failure> {
    let mut drive = open(options).map_err(DriveError)?;
    let part = restrict(&mut drive, options)?;
    Ok((drive, part))
}

/// Restricts a drive to the range to replay, and returns that. It begins with the latched samples
/// that were valid then.
pub(super) fn restrict(drive: &mut Replay, options: &ReplayOptions) -> Result<TimeRange, Failure> {
    let part = options.range.restrict(drive)?;
    if part.from_ns.is_some() {
        drive.begin_with_latched(&options.drives.named, &opening(options));
    }
    Ok(part)
}

/// Returns whether a report can hold these paths.
pub(super) fn are_text(drives: &[Vec<PathBuf>]) -> bool {
    drives.iter().flatten().all(|path| path.to_str().is_some())
}

/// Opens the drives, merged by time.
pub(super) fn open(options: &ReplayOptions) -> Result<Replay, ReplayError> {
    Replay::open_as(&options.drives.named, &opening(options))
}

/// Definitions that a drive lacks are searched for as in a live run: beside the lambda, among the
/// bundled ones, and where ROS 2 is installed.
fn opening(options: &ReplayOptions) -> replay::DriveOptions {
    let sources = Sources::new(&[options.lambda.build.path().join("msg")], &definition_dirs());
    let (unpack_in, unpacked) = (options.unpack_in.clone(), options.unpacked.clone());
    replay::DriveOptions {
        sources: Some(sources),
        merge: options.merge,
        unpack_in,
        unpacked,
        ..replay::DriveOptions::default()
    }
}

#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub(super) struct DriveError(pub(super) ReplayError);

impl Explain for DriveError {
    fn help(&self) -> Option<String> {
        let help = self.0.help();
        match self.0 {
            ReplayError::Damaged { .. } => {
                help.map(|help| format!("the results up to the damage are kept; {help}"))
            }
            _ => help,
        }
    }

    fn exit(&self) -> Exit {
        self.0.exit()
    }
}
