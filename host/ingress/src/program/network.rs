//! Turns DDS errors into failures with an exit code and help.

use gleaner_base::{Exit, Explain, Failure, ignored_variables};
use gleaner_dds::DdsError;
use tracing::warn;

/// Warns of each variable by which the nodes may be out of reach.
pub(super) fn warn_of_variables() {
    for variable in ignored_variables() {
        warn!(%variable, "Gleaner receives by DDS with multicast, and ignores this variable");
    }
}

#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub(super) struct NetworkError(DdsError);

impl NetworkError {
    /// Converts `error`; for `map_err`.
    pub(super) fn failure(error: DdsError) -> Failure {
        Self(error).into()
    }
}

impl Explain for NetworkError {
    fn help(&self) -> Option<String> {
        match &self.0 {
            DdsError::Join { .. } => {
                Some("`gleaner doctor` looks at the network of this machine".to_owned())
            }
            DdsError::Interface { .. } => {
                Some("`ip address` lists the addresses of this machine".to_owned())
            }
            DdsError::Name { .. } => Some(
                "write a name that begins with `/`, of letters, digits and `_`, as in `/gleaner/decisions`"
                    .to_owned(),
            ),
            _ => None,
        }
    }

    fn exit(&self) -> Exit {
        match &self.0 {
            DdsError::Join { .. } => Exit::Unreachable,
            _ => Exit::Usage,
        }
    }
}
