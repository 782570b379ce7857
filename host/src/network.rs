//! Which network to join, and what it means for a user that it cannot be had.

use std::net::IpAddr;

use clap::Args;
use gleaner_base::{Exit, Explain, Failure};
use gleaner_dds::{DdsError, Options};

/// Arguments that say which network to join.
#[derive(Args, Clone, Debug)]
pub struct NetworkArgs {
    /// The domain of DDS; without it that of `ROS_DOMAIN_ID`.
    #[arg(long, value_parser = clap::value_parser!(u16).range(..=232))]
    domain: Option<u16>,
    /// The address of an interface to use, instead of all.
    #[arg(long, value_name = "ADDRESS")]
    interface: Vec<IpAddr>,
}

impl NetworkArgs {
    /// What the environment says, unless the arguments say otherwise.
    pub(crate) fn options(self, node: &str) -> Result<Options, Failure> {
        let options = Options::from_env(node).map_err(NetworkError::failure)?;
        Ok(options.narrowed(self.domain, self.interface))
    }
}

/// Why DDS does not do what it was asked for.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub(crate) struct NetworkError(DdsError);

impl NetworkError {
    /// For `map_err`.
    pub(crate) fn failure(error: DdsError) -> Failure {
        Self(error).into()
    }
}

impl Explain for NetworkError {
    fn help(&self) -> Option<String> {
        match &self.0 {
            DdsError::Join { .. } => Some("`gleaner doctor` looks at the network of this machine".to_owned()),
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
