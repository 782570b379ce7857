//! Command-line arguments for the network.

use std::net::{IpAddr, UdpSocket};

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
    /// Returns the options of the node `node`: those of the environment, overridden by the
    /// arguments.
    ///
    /// # Errors
    ///
    /// Those of [`DdsOptions::from_env`]; [`DdsError::Interface`] for an address that no interface
    /// has, since a participant there would find nothing and report no error.
    pub fn options(self, node: impl Into<String>) -> Result<DdsOptions, DdsError> {
        for address in &self.interface {
            UdpSocket::bind((*address, 0))
                .map_err(|source| DdsError::Interface { address: *address, source })?;
        }
        Ok(DdsOptions::from_env(node)?.narrowed(self.domain, self.interface))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_without_an_interface_is_refused() {
        let options = |address: &str| {
            let interface = vec![address.parse().unwrap()];
            NetworkArgs { domain: Some(0), interface }.options("/gleaner/test")
        };
        // Reserved for documentation: no machine has it.
        let refused = options("192.0.2.1").unwrap_err();
        assert_eq!(refused.to_string(), "no network interface has the address 192.0.2.1");
        assert!(options("127.0.0.1").is_ok());
    }
}
