//! Command-line arguments for the network.

use std::net::IpAddr;

use super::options::{DdsError, DdsOptions};

/// Arguments that select the network. `gleaner` has the same for users, and passes them on.
#[derive(clap::Args, Clone, Debug)]
pub struct NetworkArgs {
    /// DDS domain; default: `ROS_DOMAIN_ID`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(..=232))]
    domain: Option<u16>,
    /// Address of a network interface to use; default: all
    #[arg(long, value_name = "ADDRESS")]
    interface: Vec<IpAddr>,
}

impl NetworkArgs {
    /// The options of the node `node`: those of the environment, overridden by the arguments.
    ///
    /// # Errors
    ///
    /// Those of [`DdsOptions::from_env`].
    pub fn options(self, node: impl Into<String>) -> Result<DdsOptions, DdsError> {
        Ok(DdsOptions::from_env(node)?.narrowed(self.domain, self.interface))
    }
}
