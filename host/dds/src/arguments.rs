//! The network on the command line of a program of ours.

use std::net::IpAddr;

use super::options::{DdsError, Options};

/// Arguments that say which network to join. `gleaner` has the same for people, and passes them on.
#[derive(clap::Args, Clone, Debug)]
pub struct NetworkArgs {
    /// Domain of DDS; without it that of `ROS_DOMAIN_ID`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(..=232))]
    domain: Option<u16>,
    /// Address of an interface to use; all without it
    #[arg(long, value_name = "ADDRESS")]
    interface: Vec<IpAddr>,
}

impl NetworkArgs {
    /// The options of the node `node`: what the environment says, unless the arguments say
    /// otherwise.
    ///
    /// # Errors
    ///
    /// Those of [`Options::from_env`].
    pub fn options(self, node: impl Into<String>) -> Result<Options, DdsError> {
        Ok(Options::from_env(node)?.narrowed(self.domain, self.interface))
    }
}
