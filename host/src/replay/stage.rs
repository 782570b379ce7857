//! What every run of a lambda over drives needs: rings that the drive fills, and a guest that sees them.

use std::sync::Arc;

use gleaner_protocol::manifest::Manifest;
use gleaner_protocol::{Exit, Explain, Failure, Fault};
use gleaner_transport::replay::{Replay, ReplayError};
use gleaner_transport::{Transport, TransportError};

use super::{Load, Options};
use crate::api::Session;
use crate::api::data::Topic;
use crate::guest::Guest;
use crate::input::{InputError, open_inputs};

/// A lambda before its `init`, over a drive that has not begun.
pub(super) struct Stage<T> {
    pub(super) drive: T,
    pub(super) inputs: Vec<Arc<Topic>>,
    pub(super) session: Session,
    pub(super) guest: Box<dyn Guest>,
}

impl<T: Transport> Stage<T> {
    pub(super) fn set(mut drive: T, options: &Options, manifest: &Manifest, load: Load<'_>) -> Result<Self, Failure> {
        let inputs = open_inputs(manifest, &options.remaps, &mut drive)
            .map_err(|error| Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error))?;
        let session = Session::new(inputs.clone(), options.config.clone());
        let guest = load(options, manifest, session.clone())?;
        Ok(Self { drive, inputs, session, guest })
    }
}

/// Opens the drives, merged by time.
pub(super) fn open_drives(options: &Options) -> Result<Replay, Failure> {
    Replay::open(&options.drives).map_err(|error| DriveError(error).into())
}

/// What a lambda's fault in `init` means for a run.
pub(super) fn not_started(lambda: &str, fault: Fault) -> Failure {
    let mut failure = Failure::new(Exit::LambdaFaulted, format!("cannot start lambda `{lambda}`"));
    failure.causes = vec![fault.message];
    failure
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

impl Explain for InputError {
    fn help(&self) -> Option<String> {
        let Self::Subscribe { source, .. } = self else {
            return Some("lower depth, hold or max_size of this [[input]]".to_owned());
        };
        Some(match source {
            TransportError::NoSuchTopic { .. } => "correct `topic` in lambda.toml, or pass --remap FROM:=TO".to_owned(),
            TransportError::WrongType { found, .. } => {
                format!("write type = \"{found}\" in lambda.toml, or choose another topic")
            }
            _ => return None,
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Subscribe { .. } => Exit::Usage,
            Self::Layout { .. } | Self::Memory { .. } => Exit::Internal,
        }
    }
}
