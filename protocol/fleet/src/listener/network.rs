//! The network of a client, which counts for bounds.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use axum::http::HeaderMap;
use tokio::net::unix;

/// The network of a client: an IPv4 address, or the first 64 bits of an IPv6 address, of which
/// one client can have all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ClientNetwork(IpAddr);

impl ClientNetwork {
    /// The network of this machine.
    pub const LOCAL: Self = Self(IpAddr::V4(Ipv4Addr::LOCALHOST));

    /// Returns the network of an address.
    pub fn of(address: IpAddr) -> Self {
        Self(match address.to_canonical() {
            IpAddr::V6(it) if !it.is_loopback() => {
                Ipv6Addr::from_bits(it.to_bits() & (u128::MAX << 64)).into()
            }
            address => address,
        })
    }

    /// Returns the network from which a proxy on this machine has got a request, as its header
    /// states. Only the last entry is from the proxy: clients can send all others.
    pub fn behind_proxy(self, headers: &HeaderMap) -> Self {
        let all = headers.get_all("x-forwarded-for").iter().next_back();
        let last = all.and_then(|it| it.to_str().ok()?.rsplit(',').next()?.trim().parse().ok());
        last.filter(|_| self.0.is_loopback()).map_or(self, Self::of)
    }
}

impl From<SocketAddr> for ClientNetwork {
    fn from(address: SocketAddr) -> Self {
        Self::of(address.ip())
    }
}

impl From<unix::SocketAddr> for ClientNetwork {
    fn from(_: unix::SocketAddr) -> Self {
        Self::LOCAL
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn only_the_last_entry_of_a_proxy_on_this_machine_counts() {
        let address = |text: &str| text.parse::<IpAddr>().unwrap();
        let mut headers = HeaderMap::new();
        let network = |headers: &HeaderMap, peer: &str| {
            ClientNetwork::of(address(peer)).behind_proxy(headers).0
        };
        assert_eq!(network(&headers, "127.0.0.1"), address("127.0.0.1"));
        for value in ["10.0.0.9", "10.0.0.8, 10.0.0.7"] {
            headers.append("x-forwarded-for", HeaderValue::from_static(value));
        }
        assert_eq!(network(&headers, "127.0.0.1"), address("10.0.0.7"));
        assert_eq!(network(&headers, "::1"), address("10.0.0.7"));
        assert_eq!(network(&headers, "10.0.0.1"), address("10.0.0.1"), "no proxy of ours");
        headers.append("x-forwarded-for", HeaderValue::from_static("unknown"));
        assert_eq!(network(&headers, "127.0.0.1"), address("127.0.0.1"));
    }
}
