//! Packet losses, and packets crafted to do harm.

use std::collections::BTreeSet;
use std::net::UdpSocket;
use std::process::Command;

use gleaner_dds::Dds;
use gleaner_messages::transport::{LiveSource, Qos, Transport};
use gleaner_protocol::process_stats::usage;
use gleaner_test_support::random::XorShift64;
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{PATIENCE, Peer, PeerKind};
use libtest_mimic::Failed;

use crate::receiver::{TopicReceiver, join};
use crate::rtps::{ANY, Entity, SPDP_READER, broken, data_frag, packet, valid_packets};
use crate::{DdsCase, Need, case};

const CYCLONE: Need = Need::Peer(PeerKind::Cyclone);

pub const CASES: &[DdsCase] = &[
    case("packets_lost_by_the_network_are_counted", &[CYCLONE, Need::Nft], lossy),
    case("a_thousand_broken_packets_do_no_harm", &[CYCLONE], broken_packets),
    case("fragments_of_messages_that_never_complete_take_bounded_memory", &[CYCLONE], || {
        claims(1 << 19)
    }),
    case("a_fragment_that_claims_four_gib_takes_no_memory", &[CYCLONE], || claims(u32::MAX)),
];

/// Memory that hostile packets may add to this process. RustDDS keeps 128 incomplete messages of
/// each writer for each reader.
const MEMORY_KIB: u64 = 192 << 10;

fn lossy() -> Result<(), Failed> {
    const COUNT: u64 = 1000;
    for rule in [
        "add table inet lossy",
        "add chain inet lossy in { type filter hook input priority 0 ; }",
        // A random packet in a hundred.
        "add rule inet lossy in meta l4proto udp numgen random mod 100 == 0 counter drop",
    ] {
        if !Command::new("nft").args(rule.split(' ')).status()?.success() {
            return Err(format!("nft rejects `{rule}`").into());
        }
    }
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    let _peer = Peer::start(PeerKind::Cyclone.publisher(
        MessageType::Imu,
        "/sensor",
        &format!("--count {COUNT} --rate 200"),
    ));
    let samples = receiver.wait("all messages, or a count of lost ones", |samples| {
        let lost = dds.status(receiver.subscription).lost.unwrap_or(0);
        samples.len() as u64 + lost >= COUNT
    })?;
    let lost = dds.status(receiver.subscription).lost;
    let rules = Command::new("nft").args(["list", "ruleset"]).output()?;
    let rules = String::from_utf8_lossy(&rules.stdout).into_owned();
    println!(
        "{} arrived, lost: {lost:?}; {}",
        samples.len(),
        rules.lines().find(|l| l.contains("counter")).unwrap_or("")
    );
    if rules.contains("packets 0 ") {
        return Err("no packet was dropped: the test has no effect".into());
    }
    let distinct: BTreeSet<_> = samples.iter().map(|sample| sample.meta.seq).collect();
    let (arrived, lost) = (samples.len() as u64, lost.unwrap_or(0));
    if distinct.len() != samples.len() || arrived + lost != COUNT {
        return Err(format!(
            "{arrived} arrived, {} of them different, {lost} counted as lost",
            distinct.len()
        )
        .into());
    }
    Ok(())
}

/// Starts a peer that publishes; returns it with both parts of its writer's id.
fn victim(dds: &mut Dds) -> Result<(Peer, [u8; 12], Entity), Failed> {
    let receiver = TopicReceiver::new(dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    let victim = Peer::start(PeerKind::Cyclone.publisher(
        MessageType::Imu,
        "/sensor",
        "--count 0 --rate 100",
    ));
    let writer =
        receiver.wait("a writer to impersonate", |samples| samples.len() >= 20)?[0].meta.writer.0;
    Ok((victim, *writer.first_chunk().unwrap(), *writer.last_chunk().unwrap()))
}

fn broken_packets() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let ports = udp_ports()?;
    let announcement = announcement(&ports)?;
    let (victim, prefix, entity) = victim(&mut dds)?;
    let before = memory_kib()?;
    let mut seeds = valid_packets(prefix, entity, &MessageType::Imu.message(1).cdr());
    // The same from an unknown participant, and the announcement of a real one.
    seeds.extend(valid_packets([0x77; 12], entity, &MessageType::Imu.message(1).cdr()));
    seeds.extend(vec![announcement; 10]);
    let mut random = XorShift64(0x9e37_79b9_7f4a_7c15);
    let (socket, mut sent) = (UdpSocket::bind("127.0.0.1:0")?, 0);
    while sent < 1000 {
        let packet = broken(&seeds[random.below(seeds.len())], &mut random);
        for port in &ports {
            socket.send_to(&packet, ("127.0.0.1", *port))?;
        }
        sent += 1;
    }
    // An attacker who uses a writer's id can send in its name, and may have announced its end.
    // Other writers are still received.
    drop(victim);
    still_receives(&mut dds)?;
    let after = memory_kib()?;
    println!(
        "{sent} broken packets to each of {} ports; memory at most {before}, then {after} KiB",
        ports.len()
    );
    if let Some(dead) = dds.health().dead {
        return Err(format!(
            "valid messages arrive, but the participant reports its death: {dead}"
        )
        .into());
    }
    if after - before > MEMORY_KIB {
        return Err(format!("memory rose from {before} to {after} KiB").into());
    }
    Ok(())
}

/// Sends fragments of 500 messages with the claimed size `size`, to the test's reader and to one
/// that every participant has.
fn claims(size: u32) -> Result<(), Failed> {
    let mut dds = join(None)?;
    let ports = udp_ports()?;
    let (victim, prefix, entity) = victim(&mut dds)?;
    let before = memory_kib()?;
    let socket = UdpSocket::bind("127.0.0.1:0")?;
    for seq in 0..500 {
        for reader in [ANY, SPDP_READER] {
            let fragment =
                packet(prefix, &[data_frag(reader, entity, 100_000 + seq, size, &[0; 1000])]);
            for port in &ports {
                socket.send_to(&fragment, ("127.0.0.1", *port))?;
            }
        }
    }
    drop(victim);
    still_receives(&mut dds)?;
    let after = memory_kib()?;
    println!(
        "1000 fragments that claim {size} bytes each: memory at most {before}, then {after} KiB"
    );
    if after - before > MEMORY_KIB {
        Err(format!("memory rose from {before} to {after} KiB").into())
    } else {
        Ok(())
    }
}

/// A new writer on a new topic: every message arrives.
fn still_receives(dds: &mut Dds) -> Result<(), Failed> {
    let receiver = TopicReceiver::new(dds, MessageType::TimeReference, "/after", Qos::Auto)?;
    let options = "--count 200 --rate 200";
    let _peer =
        Peer::start(PeerKind::Cyclone.publisher(MessageType::TimeReference, "/after", options));
    receiver.all(dds, 200)
}

/// The ports of all UDP sockets in this network, to be called while only this process has some.
pub fn udp_ports() -> Result<Vec<u16>, Failed> {
    let table = std::fs::read_to_string("/proc/self/net/udp")?;
    let port = |line: &str| {
        u16::from_str_radix(line.split_whitespace().nth(1)?.split_once(':')?.1, 16).ok()
    };
    let mut ports: Vec<u16> = table.lines().skip(1).filter_map(port).collect();
    ports.sort_unstable();
    ports.dedup();
    if ports.len() < 2 { Err(format!("there are no sockets: {table}").into()) } else { Ok(ports) }
}

/// The announcement that a participant sends, with the id of one that does not exist.
///
/// The participant sends it to the first ports that others on this machine might have; a plain
/// socket on one of those receives it.
pub fn announcement(own: &[u16]) -> Result<Vec<u8>, Failed> {
    // DDSI-RTPS 2.3, section 9.6.1: unicast discovery in domain 0 is at 7410 and two more for each
    // participant.
    let sockets =
        (1..12).map(|participant| 7410 + 2 * participant).filter(|port| !own.contains(port));
    let socket = sockets.filter_map(|port| UdpSocket::bind(("127.0.0.1", port)).ok()).next_back();
    let socket = socket.ok_or("all ports of discovery are taken")?;
    socket.set_read_timeout(Some(PATIENCE))?;
    let mut buffer = vec![0; 1 << 16];
    let length = socket.recv(&mut buffer)?;
    buffer.truncate(length);
    let prefix: [u8; 12] =
        buffer.get(8..20).and_then(|prefix| prefix.try_into().ok()).ok_or("a packet of RTPS")?;
    for at in 0..buffer.len().saturating_sub(11) {
        if buffer[at..at + 12] == prefix {
            buffer[at..at + 12].fill(0x66);
        }
    }
    Ok(buffer)
}

/// The most memory that this process ever had, in KiB.
fn memory_kib() -> Result<u64, Failed> {
    match usage::peak_resident() {
        0 => Err("cannot determine the memory of this process".into()),
        bytes => Ok(bytes >> 10),
    }
}
