//! Opening drives, and what it means that one cannot be read.

use gleaner_protocol::{Exit, Explain, Failure};
use gleaner_transport::replay::{Replay, ReplayError};

use super::Options;

/// Opens the drives, merged by time.
pub(super) fn open_drives(options: &Options) -> Result<Replay, Failure> {
    Replay::open(&options.drives).map_err(|error| DriveError(error).into())
}

/// A drive that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub(super) struct DriveError(pub(super) ReplayError);

impl Explain for DriveError {
    fn help(&self) -> Option<String> {
        matches!(self.0, ReplayError::Damaged { .. })
            .then(|| "the results up to the damage are kept; copy the file again if you can".to_owned())
    }

    fn exit(&self) -> Exit {
        match self.0 {
            ReplayError::Damaged { .. } => Exit::DriveDamaged,
            ReplayError::Read { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}
