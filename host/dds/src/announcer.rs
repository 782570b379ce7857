//! Repeats the announcement of our participant, which may be lost.
//!
//! RustDDS announces a participant once when it starts, once to each new participant, and otherwise
//! every 10 s. Other nodes discover it by this one datagram. At a packet loss of 5 %, one start in
//! 20 matched nothing until the next announcement: 5 s later with Cyclone DDS, which announces
//! itself every 8 s. RustDDS has no function to announce a participant, and no option for the
//! interval.
//!
//! So its own datagram is sent again a few times, unchanged, to the same multicast group. RustDDS
//! also sends it to the ports of the first twelve participants of this machine: one of these ports,
//! if no participant has it, is opened here until a copy has arrived. Receivers take the copy for
//! the original, if they missed that one, and else ignore it, as a network may duplicate datagrams.
//! Fast DDS announces new participants as often.
//!
//! Without multicast, only participants of this machine are found, and nothing is repeated.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use gleaner_protocol::ingress::DISCOVERY_GROUP;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use socket2::SockRef;
use tracing::debug;

use super::filter::Prefix;
use super::sockets::port_of_samples;

/// The participants of this machine whose ports are tried, and to which RustDDS sends in any case:
/// the last ones of twelve, as participants take the first free ones.
const INDICES: std::ops::RangeInclusive<u16> = 8..=11;
/// Times of the repetitions after the start, or after the discovery of a participant.
const AFTER: [Duration; 5] = [
    Duration::from_millis(200),
    Duration::from_millis(400),
    Duration::from_millis(800),
    Duration::from_millis(1600),
    Duration::from_millis(3200),
];
/// The longest announcement that is repeated.
const LONGEST: usize = 8 << 10;
/// Most datagrams that are read at a time, and most interfaces that are used.
const MAX_READ: usize = 64;
const MAX_INTERFACES: usize = 16;

/// A port at which RustDDS announces our participant, to be opened before there is one.
pub(super) struct Announcements(Option<UdpSocket>);

impl Announcements {
    pub(super) fn of(domain: u16) -> Self {
        let port = |index: u16| port_of_samples(domain) + 9 + 2 * index;
        let open = |index| {
            let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, port(index))).ok()?;
            socket.set_nonblocking(true).ok()?;
            Some(socket)
        };
        Self(INDICES.rev().find_map(open))
    }

    /// Returns the announcement of the participant with this prefix, if it has arrived.
    fn read(&self, own: Prefix) -> Option<Vec<u8>> {
        let mut bytes = vec![0; LONGEST + 1];
        for _ in 0..MAX_READ {
            let (length, _) = self.0.as_ref()?.recv_from(&mut bytes).ok()?;
            let datagram = &bytes[..length];
            // Other programs of this machine send to this port, too. RTPS: the header is "RTPS",
            // version, vendor and prefix.
            let is_own = datagram.starts_with(b"RTPS") && datagram.get(8..20) == Some(&own);
            if is_own && length <= LONGEST {
                return Some(datagram.to_vec());
            }
        }
        None
    }
}

/// Repeats the announcement of one participant.
pub(super) struct Announcer {
    announcements: Announcements,
    announcement: Option<Vec<u8>>,
    own: Prefix,
    group: SocketAddrV4,
    /// One for each interface.
    senders: Vec<UdpSocket>,
    /// The start of the repetitions, and the index of the next one.
    from: Instant,
    next: usize,
}

impl Announcer {
    /// Repeats the announcement of the participant with this prefix on `interfaces`; on all if
    /// there are none.
    pub(super) fn new(
        announcements: Announcements,
        own: Prefix,
        domain: u16,
        interfaces: &[IpAddr],
    ) -> Self {
        let senders = senders(interfaces).unwrap_or_else(|error| {
            debug!(%error, "cannot repeat announcements");
            Vec::new()
        });
        let group = SocketAddrV4::new(DISCOVERY_GROUP, port_of_samples(domain) - 1);
        let (from, next) = (Instant::now(), 0);
        Self { announcements, announcement: None, own, group, senders, from, next }
    }

    /// The addresses from which it is repeated.
    pub(super) fn addresses(&self) -> Vec<Ipv4Addr> {
        let address = |sender: &UdpSocket| match sender.local_addr().ok()?.ip() {
            IpAddr::V4(address) => Some(address),
            IpAddr::V6(_) => None,
        };
        self.senders.iter().filter_map(address).collect()
    }

    /// Repeats the announcement from now on: a new participant may miss our answer to it.
    pub(super) fn restart(&mut self) {
        // A repetition that is due sooner stays, so that participants without end, each of which
        // restarts this, delay none.
        if self.until_due(Instant::now()).is_none_or(|due| due > AFTER[0]) {
            (self.from, self.next) = (Instant::now(), 0);
        }
    }

    /// The time until the next repetition; `None` after the last one.
    pub(super) fn until_due(&self, now: Instant) -> Option<Duration> {
        let after = AFTER.get(self.next).filter(|_| !self.senders.is_empty())?;
        Some((self.from + *after).saturating_duration_since(now))
    }

    /// Sends the repetition that is due, if one is.
    pub(super) fn poll(&mut self) {
        if self.until_due(Instant::now()) != Some(Duration::ZERO) {
            return;
        }
        self.next += 1;
        if self.announcement.is_none() {
            self.announcement = self.announcements.read(self.own);
            if self.announcement.is_some() {
                // The port is free for another participant.
                self.announcements = Announcements(None);
            }
        }
        let Some(announcement) = &self.announcement else { return };
        for sender in &self.senders {
            // An interface that is down now may be up at the next repetition.
            drop(sender.send_to(announcement, self.group));
        }
    }
}

/// Sockets that send to a group by one of our interfaces each.
fn senders(interfaces: &[IpAddr]) -> io::Result<Vec<UdpSocket>> {
    let addresses = getifaddrs()?.filter_map(|interface| {
        let is_used =
            interface.flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST);
        interface.address?.as_sockaddr_in().map(|address| address.ip()).filter(|_| is_used)
    });
    let sender = |address: Ipv4Addr| {
        let socket = UdpSocket::bind((address, 0))?;
        SockRef::from(&socket).set_multicast_if_v4(&address)?;
        socket.set_nonblocking(true)?;
        Ok(socket)
    };
    addresses
        .filter(|address| interfaces.is_empty() || interfaces.contains(&IpAddr::V4(*address)))
        .take(MAX_INTERFACES)
        .map(sender)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN: Prefix = [7; 12];

    fn announcer(socket: UdpSocket) -> (Announcer, UdpSocket) {
        let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
        let std::net::SocketAddr::V4(group) = receiver.local_addr().unwrap() else { panic!() };
        socket.set_nonblocking(true).unwrap();
        let senders = vec![UdpSocket::bind("127.0.0.1:0").unwrap()];
        let (announcements, from, next) = (Announcements(Some(socket)), Instant::now(), 0);
        let announcer =
            Announcer { announcements, announcement: None, own: OWN, group, senders, from, next };
        (announcer, receiver)
    }

    fn datagram(prefix: Prefix, length: usize) -> Vec<u8> {
        let mut bytes = b"RTPS\x02\x03\x01\x12".to_vec();
        bytes.extend_from_slice(&prefix);
        bytes.resize(length, 1);
        bytes
    }

    #[test]
    fn our_own_announcement_is_repeated_unchanged_and_nothing_else_is() {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = socket.local_addr().unwrap();
        let (mut announcer, receiver) = announcer(socket);
        let other = UdpSocket::bind("127.0.0.1:0").unwrap();
        let own = datagram(OWN, 300);
        for sent in [
            &datagram([8; 12], 300),
            &datagram(OWN, LONGEST + 1),
            &vec![],
            &own[..19].to_vec(),
            &own,
        ] {
            other.send_to(sent, to).unwrap();
        }
        let mut bytes = [0; 1000];
        for _ in AFTER {
            announcer.from = Instant::now() - AFTER[4];
            announcer.poll();
            let (length, _) = receiver.recv_from(&mut bytes).unwrap();
            assert_eq!(bytes[..length], own);
        }
        assert_eq!(announcer.until_due(Instant::now()), None);
        announcer.poll();
        receiver.set_nonblocking(true).unwrap();
        assert!(receiver.recv_from(&mut bytes).is_err(), "no sixth repetition");
    }

    #[test]
    fn new_participants_restart_the_repetitions_and_many_do_not_delay_them() {
        let (mut announcer, _receiver) = announcer(UdpSocket::bind("127.0.0.1:0").unwrap());
        let begun = announcer.from;
        announcer.restart();
        assert_eq!(announcer.from, begun, "one is due soon");
        announcer.next = 3;
        announcer.restart();
        assert_eq!(announcer.next, 0);
        announcer.next = AFTER.len();
        announcer.restart();
        assert_eq!(announcer.next, 0);
        let now = Instant::now();
        assert!(announcer.until_due(now).unwrap() <= AFTER[0]);
        // A thread that was stopped sends them one by one.
        announcer.from = now - Duration::from_secs(60);
        assert_eq!(announcer.until_due(now), Some(Duration::ZERO));
    }
}
