//! Denies sockets: new ones to a lambda's process, from its first instruction on, and all but UDP
//! to the ingress. Open sockets stay usable, and a process can still receive files over them.

use gleaner_protocol::Layer;

use crate::filter::{ALL, DeniedCalls, install};
use crate::layer;

/// The name of the layer of a process that creates no sockets.
pub const NAME: &str = "sockets";
/// The name of the layer of a process that creates no sockets but those of the internet.
pub const INTERNET_ONLY: &str = "local sockets";
/// The name of the layer of a process that creates UDP sockets only.
pub const UDP_ONLY: &str = "stream sockets";

const ACCEPTING: &[i64] = &[libc::SYS_listen, libc::SYS_accept, libc::SYS_accept4];
const CREATING: &[i64] = &[libc::SYS_socket, libc::SYS_bind, libc::SYS_connect];
/// Calls that send files, and the kernel counts those in flight for all processes of a user.
const SENDING_FILES: &[i64] = &[libc::SYS_sendmsg, libc::SYS_sendmmsg];

/// Families of sockets that DDS and pip need: the last one lists the interfaces of the network.
const FAMILIES: [i32; 3] = [libc::AF_INET, libc::AF_INET6, libc::AF_NETLINK];
/// Number of socket families: those of Linux, and some to come.
const ALL_FAMILIES: i32 = 64;
/// Socket types that DDS does not use: streams above all, which may connect.
const OTHER_TYPES: [u64; 5] = [1, 4, 5, 6, 10];

/// The bits of a socket's type that are not flags.
const TYPE: u64 = 0xf;

/// Denies new sockets, connections and the sending of files to this process and its descendants. A
/// pair of connected streams, which no other process can reach, is still allowed.
pub fn deny() -> Layer {
    let denied = none(DeniedCalls::default()).filter(libc::EPERM);
    let installed = denied.and_then(|filter| install(&filter)).map_err(|error| error.chain());
    layer(NAME, "seccomp: no new sockets, no connections, from the start", installed)
}

/// Denies the calls of [`deny`].
pub(crate) fn none(refused: DeniedCalls) -> DeniedCalls {
    no_new(refused).calls(SENDING_FILES)
}

/// Denies new sockets and connections. Files can be sent.
pub(crate) fn no_new(refused: DeniedCalls) -> DeniedCalls {
    pairs_only(refused).calls(CREATING).calls(ACCEPTING)
}

/// Denies new sockets but local ones that only receive, and connections. CUDA does not start unless
/// it can listen on one, and connects none. Landlock denies those with a path.
pub(crate) fn local_listeners_only(refused: DeniedCalls) -> DeniedCalls {
    let refused = pairs_only(refused).calls(&[libc::SYS_connect]).unless(
        libc::SYS_socket,
        0,
        libc::AF_UNIX as u64,
    );
    // Datagrams could be sent without a connection.
    let others = (0..=TYPE).filter(|kind| *kind != libc::SOCK_SEQPACKET as u64);
    others.fold(refused, |refused, kind| refused.bits(libc::SYS_socket, 1, TYPE, kind))
}

/// Denies all new sockets but those of the internet, which connect and do not listen, and those
/// that list the interfaces of the network.
pub(crate) fn internet_only(refused: DeniedCalls) -> DeniedCalls {
    let mut refused = pairs_only(refused).calls(ACCEPTING);
    for family in (0..ALL_FAMILIES).filter(|family| !FAMILIES.contains(family)) {
        refused = refused.bits(libc::SYS_socket, 0, ALL, u64::from(family.unsigned_abs()));
    }
    refused
}

pub(crate) fn udp_only(refused: DeniedCalls) -> DeniedCalls {
    let refused = internet_only(refused);
    OTHER_TYPES
        .into_iter()
        .fold(refused, |refused, kind| refused.bits(libc::SYS_socket, 1, TYPE, kind))
}

/// Limits pairs of sockets to streams: other kinds can send to any named socket.
fn pairs_only(refused: DeniedCalls) -> DeniedCalls {
    refused
        .unless(libc::SYS_socketpair, 0, libc::AF_UNIX as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_DGRAM as u64)
        .bits(libc::SYS_socketpair, 1, TYPE, libc::SOCK_RAW as u64)
}
