//! Opening drives, and what it means that one cannot be read.

use std::path::PathBuf;

use gleaner_base::{Exit, Explain, Failure};
use gleaner_drives as replay;
use gleaner_drives::{Replay, ReplayError, files_of};
use gleaner_journal::Part;
use gleaner_messages::Sources;

use super::Options;
use super::options::Drives;
use crate::isolation::definitions;

impl Drives {
    /// What these paths name.
    pub(super) fn find(named: Vec<PathBuf>) -> Result<Self, Failure> {
        let files = files_of(&named).map_err(DriveError)?;
        // Under whatever name.
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

/// Opens the drives, merged by time, and says which part of them is replayed.
pub(super) fn open_drives(options: &Options) -> Result<(Replay, Part), Failure> {
    let mut drive = open(options).map_err(DriveError)?;
    let part = options.part.restrict(&mut drive)?;
    Ok((drive, part))
}

/// Opens the drives, merged by time.
///
/// What a drive does not say of its types is looked for as live: beside the lambda, among those
/// that are bundled, where ROS 2 is installed.
pub(super) fn open(options: &Options) -> Result<Replay, ReplayError> {
    let sources = Sources::new(&[options.asked.build.path().join("msg")], &definitions());
    let (unpack_in, unpacked) = (options.unpack_in.clone(), options.unpacked.clone());
    let opening = replay::Options {
        sources: Some(sources),
        unpack_in,
        unpacked,
        ..replay::Options::default()
    };
    Replay::open_as(&options.drives.named, &opening)
}

/// A drive that cannot be read.
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
        match self.0 {
            ReplayError::Damaged { .. } => Exit::DriveDamaged,
            ReplayError::Read { .. } | ReplayError::Unpack { .. } | ReplayError::NoRoom { .. } => {
                Exit::Internal
            }
            _ => Exit::Usage,
        }
    }
}
