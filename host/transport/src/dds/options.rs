//! How a domain is joined.

use std::net::IpAddr;
use std::path::PathBuf;

use super::Clock;

/// A distribution of ROS 2, as far as nodes of others have to know it of us.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Distro {
    /// Humble and older: names of endpoints have 24 bytes in the graph.
    Humble,
    /// Iron and newer: 16 bytes.
    Newer,
}

/// How a domain is joined.
#[derive(Clone, Debug)]
pub struct Options {
    /// The domain; `ROS_DOMAIN_ID`.
    pub domain: u16,
    /// Addresses of the interfaces to use; all if empty.
    pub interfaces: Vec<IpAddr>,
    /// Namespace and name of the node that others see, for example `/gleaner/hello`.
    pub node: String,
    /// The distribution of the others; `None`: found out from what they say.
    pub distro: Option<Distro>,
    /// Bytes of the largest sample, by which socket buffers are sized.
    pub largest: usize,
    /// Folders with message definitions, looked through first.
    pub messages: Vec<PathBuf>,
    /// The clock of receive stamps.
    pub clock: Clock,
}

/// Why DDS does not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum DdsError {
    /// No participant.
    #[error("cannot join domain {domain}")]
    Join {
        /// The domain.
        domain: u16,
        /// What the library says.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}
