//! Notices that the cloud may be reachable another way.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket};
use std::time::Duration;

use tokio::time::sleep;

/// Interval of looks.
const LOOKS: Duration = Duration::from_secs(2);

/// Returns the addresses from which this machine reaches others, over IPv4 and IPv6: they change
/// with its links, addresses and default routes, but not with the links of containers.
pub(super) fn sources() -> [Option<IpAddr>; 2] {
    let source = |any: IpAddr, other: IpAddr| {
        let socket = UdpSocket::bind((any, 0)).ok()?;
        // It sends nothing. The address is one for documentation.
        socket.connect((other, 9)).ok()?;
        Some(socket.local_addr().ok()?.ip())
    };
    [
        source(Ipv4Addr::UNSPECIFIED.into(), Ipv4Addr::new(192, 0, 2, 1).into()),
        source(Ipv6Addr::UNSPECIFIED.into(), Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1).into()),
    ]
}

/// Waits until the addresses are others.
pub(super) async fn others_than(before: [Option<IpAddr>; 2]) {
    while sources() == before {
        sleep(LOOKS).await;
    }
}
