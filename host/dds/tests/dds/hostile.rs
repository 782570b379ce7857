//! Tests with handcrafted packets of an attacker or of broken software.

use std::net::UdpSocket;

use gleaner_dds::Dds;
use gleaner_messages::transport::{LiveSource, Qos, Transport};
use rustdds::{GUID, RTPSEntity};

use super::Test;
use super::peer::{Subscribed, connected, matched, subscribed, until, write};

pub const TESTS: &[Test] = &[
    ("gaps_in_sequence_numbers_are_lost_samples_until_they_arrive_late", gaps),
    ("an_unreadable_sample_counts_as_malformed_but_not_as_lost", malformed),
    ("a_jump_to_the_last_sequence_number_does_not_overflow", last_number),
    ("thousands_of_broken_packets_do_not_stop_reception", broken),
    ("fragments_that_claim_gibibytes_take_no_memory_and_are_counted", claims),
    ("huge_ranges_in_a_heartbeat_or_a_gap_take_no_memory_and_are_counted", numbers),
];

/// An RTPS packet of `writer` with one submessage.
pub fn packet(writer: GUID, kind: u8, body: &[u8]) -> Vec<u8> {
    let mut packet = b"RTPS\x02\x04\x01\x10".to_vec();
    packet.extend_from_slice(&writer.to_bytes()[..12]);
    packet.extend_from_slice(&[kind, 5]);
    packet.extend_from_slice(&u16::try_from(body.len()).unwrap().to_le_bytes());
    packet.extend_from_slice(body);
    packet
}

/// Little-endian CDR.
pub const LITTLE: [u8; 2] = [0, 1];

/// A DATA submessage: to all readers, from `writer`, with number `seq`.
pub fn data(writer: GUID, seq: i64, payload: &[u8], encoding: [u8; 2]) -> Vec<u8> {
    let mut body = vec![0, 0, 16, 0, 0, 0, 0, 0];
    body.extend_from_slice(&writer.to_bytes()[12..]);
    body.extend_from_slice(&((seq >> 32) as i32).to_le_bytes());
    body.extend_from_slice(&(seq as u32).to_le_bytes());
    body.extend_from_slice(&[encoding, [0; 2]].concat());
    body.extend_from_slice(payload);
    packet(writer, 0x15, &body)
}

/// A DATA_FRAG submessage: the first fragment, for all readers, of a sample that claims to have
/// `size` bytes.
fn fragment(writer: GUID, seq: u32, size: u32) -> Vec<u8> {
    let mut body = vec![0, 0, 28, 0, 0, 0, 0, 0];
    body.extend_from_slice(&writer.to_bytes()[12..]);
    body.extend_from_slice(&[0; 4]);
    for word in [seq, 1, 1000 << 16 | 1, size] {
        body.extend_from_slice(&word.to_le_bytes());
    }
    body.extend_from_slice(&[0; 1000]);
    packet(writer, 0x16, &body)
}

/// A HEARTBEAT (7) or a GAP (8) of `numbers`, to all readers, with a new count.
fn range(writer: GUID, kind: u8, numbers: [u64; 2]) -> Vec<u8> {
    let mut body = vec![0; 4];
    body.extend_from_slice(&writer.to_bytes()[12..]);
    for number in numbers {
        body.extend_from_slice(&((number >> 32) as u32).to_le_bytes());
        body.extend_from_slice(&(number as u32).to_le_bytes());
    }
    // The HEARTBEAT's count; the GAP has no further numbers.
    body.extend_from_slice(&(if kind == 7 { i32::MAX } else { 0 }).to_le_bytes());
    packet(writer, kind, &body)
}

/// Peak memory of this process, in bytes.
fn most_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}

/// Number of datagrams that were dropped.
fn counted(dds: &Dds) -> u64 {
    let network = dds.health().network.unwrap();
    network.filtered + network.socket_drops
}

/// The port at which the first participant of a domain receives data.
fn port(domain: u16) -> u16 {
    7400 + 250 * domain + 11
}

/// Sends a packet to the first participant of a domain.
pub fn send(domain: u16, packet: &[u8]) {
    let wire = UdpSocket::bind("127.0.0.1:0").unwrap();
    wire.send_to(packet, ("127.0.0.1", port(domain))).unwrap();
}

fn gaps() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/gaps", Qos::Auto);
    let writer = peer.writer("/gaps", false, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    write(&writer, b"1...");
    sink.wait(1);
    for (count, (seq, lost)) in
        [(5, 3), (6, 3), (3, 2), (9, 4), (4, 3), (2, 2), (8, 1)].into_iter().enumerate()
    {
        send(domain, &data(writer.guid(), seq, b"handcrafted", LITTLE));
        assert_eq!(sink.wait(count + 2)[count + 1].0.seq, u64::try_from(seq).unwrap());
        until("the count", || dds.status(subscription).lost == Some(lost));
    }
}

fn malformed() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/odd", Qos::Auto);
    let writer = peer.writer("/odd", false, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    write(&writer, b"1...");
    sink.wait(1);
    // PL_CDR and XCDR2; the fourth sample really is lost.
    for (seq, encoding) in [(2, [0, 3]), (3, [0, 7]), (5, LITTLE)] {
        send(domain, &data(writer.guid(), seq, b"handcrafted.", encoding));
    }
    sink.wait(2);
    until("the loss", || dds.status(subscription).lost != Some(0));
    let status = dds.status(subscription);
    assert_eq!((status.malformed, status.lost), (2, Some(1)));
}

fn last_number() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/jump", Qos::Auto);
    let (writer, other) = (peer.writer("/jump", false, false), peer.writer("/jump", false, false));
    connected(&dds, subscription, 2);
    matched(&writer);
    write(&writer, b"1...");
    sink.wait(1);
    for seq in [i64::MAX, i64::MAX - 1, 0, -1, i64::MIN] {
        send(domain, &data(writer.guid(), seq, b"?", LITTLE));
    }
    sink.mark(&other, b"still here..");
    assert!(dds.status(subscription).lost.unwrap() >= i64::MAX as u64 - 3);
    assert_eq!(dds.health().dead, None);
}

fn broken() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/broken", Qos::Auto);
    let writer = peer.writer("/broken", true, false);
    connected(&dds, subscription, 1);
    let wire = UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut state = 1_u64;
    let mut random = move || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    let whole = data(writer.guid(), 7, &[0; 64], LITTLE);
    let kinds =
        [0x01, 0x06, 0x07, 0x08, 0x09, 0x0c, 0x0d, 0x0e, 0x0f, 0x12, 0x13, 0x15, 0x16, 0x80, 0xff];
    for n in 0..3000 {
        let mut bytes = match n % 3 {
            // Truncated anywhere; some bytes changed; and every kind of submessage with random
            // bytes.
            0 => whole[..random() % whole.len()].to_vec(),
            1 => whole.clone(),
            _ => packet(
                writer.guid(),
                kinds[random() % kinds.len()],
                &vec![random() as u8; random() % 80],
            ),
        };
        for _ in 0..3 {
            // Neither the sender nor the RTPS magic.
            let at = 20 + random() % 200;
            if let Some(byte) = bytes.get_mut(at) {
                *byte = random() as u8;
            }
        }
        wire.send_to(&bytes, ("127.0.0.1", port(domain) - u16::from(n % 5 == 0))).unwrap();
    }
    let fresh = peer.writer("/broken", true, false);
    sink.mark(&fresh, b"still here..");
    assert_eq!(dds.health().dead, None);
}

fn claims() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/claims", Qos::Auto);
    let writer = peer.writer("/claims", true, false);
    connected(&dds, subscription, 1);
    assert_eq!(dds.health().network.unwrap().unfiltered, None);
    let before = most_memory();
    let send = |bytes: &[u8]| send(domain, bytes);
    let begun = counted(&dds);
    let mut stranger = writer.guid().to_bytes();
    stranger[5] ^= 0xff;
    let stranger = GUID::from_bytes(stranger);
    for guid in [writer.guid(), stranger] {
        send(&fragment(guid, 1000, u32::MAX));
    }
    for seq in 0..1000 {
        send(&fragment(writer.guid(), 2000 + seq, 64 << 20));
        send(&fragment(stranger, 2000 + seq, 1 << 19));
    }
    until("the count", || counted(&dds) - begun >= 2002);
    let fresh = peer.writer("/claims", true, false);
    sink.mark(&fresh, &[7; 100_000]);
    assert_eq!(dds.health().dead, None);
    // Other tests run at the same time. The claims are 67 GiB.
    assert!(most_memory() - before < 1 << 30, "{} MiB", (most_memory() - before) >> 20);
}

fn numbers() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/numbers", Qos::Auto);
    let writer = peer.writer("/numbers", true, false);
    connected(&dds, subscription, 1);
    sink.mark(&writer, b"before..");
    assert_eq!(dds.health().network.unwrap().unfiltered, None);
    // The built-in writer of announcements: every participant's reader of them receives it.
    let mut announcer = writer.guid().to_bytes();
    announcer[12..].copy_from_slice(&[0, 0, 3, 0xc2]);
    let (before, begun) = (most_memory(), counted(&dds));
    for guid in [writer.guid(), GUID::from_bytes(announcer)] {
        // Without the filter, some GiB each: enough to be noticed, without taking down the machine.
        for (kind, numbers) in [(7, [1, 1 << 28]), (8, [1 << 20, 1 << 26])] {
            send(domain, &range(guid, kind, numbers));
        }
    }
    until("the count", || counted(&dds) - begun >= 4);
    sink.mark(&writer, b"after...");
    let fresh = peer.writer("/numbers", true, false);
    sink.mark(&fresh, b"still here..");
    assert_eq!(dds.health().dead, None);
    assert!(most_memory() - before < 1 << 30, "{} MiB", (most_memory() - before) >> 20);
}
