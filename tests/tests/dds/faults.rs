//! Losses, and packets that somebody made to do harm.

use std::collections::BTreeSet;
use std::net::UdpSocket;
use std::process::Command;

use gleaner_dds::Dds;
use gleaner_tests::peers::message::Type;
use gleaner_tests::peers::{Kind, PATIENCE, Peer};
use gleaner_transport::{LiveSource, Qos, Transport};
use gleaner_vitals::usage;
use libtest_mimic::Failed;

use crate::ours::{Heard, join};
use crate::rtps::{ANY, Entity, Random, SPDP_READER, broken, data_frag, packet, sound};
use crate::{Case, Need};

const CYCLONE: Need = Need::Peer(Kind::Cyclone);

pub const CASES: &[Case] = &[
    Case {
        name: "of_a_network_that_loses_packets_nothing_is_lost_silently",
        needs: &[CYCLONE, Need::Nft],
        run: lossy,
    },
    Case { name: "a_thousand_broken_packets_do_no_harm", needs: &[CYCLONE], run: broken_packets },
    Case {
        name: "fragments_of_messages_that_never_come_whole_take_bounded_memory",
        needs: &[CYCLONE],
        run: || claims(1 << 19),
    },
    Case {
        name: "a_fragment_that_claims_four_gib_takes_no_memory",
        needs: &[CYCLONE],
        run: || claims(u32::MAX),
    },
];

/// What hostile packets may add to this process's memory. RustDDS keeps 128 unfinished messages of
/// each writer for each reader.
const MEMORY_KIB: u64 = 192 << 10;

fn lossy() -> Result<(), Failed> {
    const COUNT: u64 = 1000;
    for rule in [
        "add table inet lossy",
        "add chain inet lossy in { type filter hook input priority 0 ; }",
        // One packet of a hundred, by chance.
        "add rule inet lossy in meta l4proto udp numgen random mod 100 == 0 counter drop",
    ] {
        if !Command::new("nft").args(rule.split(' ')).status()?.success() {
            return Err(format!("nft refuses `{rule}`").into());
        }
    }
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let _peer = Peer::start(Kind::Cyclone.publisher(
        Type::Imu,
        "/sensor",
        &format!("--count {COUNT} --rate 200"),
    ));
    let samples = heard.wait("all messages, or word of their loss", |samples| {
        let lost = dds.status(heard.subscription).lost.unwrap_or(0);
        samples.len() as u64 + lost >= COUNT
    })?;
    let lost = dds.status(heard.subscription).lost;
    let rules = Command::new("nft").args(["list", "ruleset"]).output()?;
    let rules = String::from_utf8_lossy(&rules.stdout).into_owned();
    println!(
        "{} arrived, lost: {lost:?}; {}",
        samples.len(),
        rules.lines().find(|l| l.contains("counter")).unwrap_or("")
    );
    if rules.contains("packets 0 ") {
        return Err("nothing was dropped: the test shows nothing".into());
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

fn broken_packets() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let ports = udp_ports()?;
    let announcement = announcement(&ports)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let victim = Peer::start(Kind::Cyclone.publisher(Type::Imu, "/sensor", "--count 0 --rate 100"));
    let writer =
        heard.wait("a writer to speak for", |samples| samples.len() >= 20)?[0].meta.writer.0;
    let before = memory_kib()?;

    let (prefix, entity): ([u8; 12], Entity) =
        (*writer.first_chunk().unwrap(), *writer.last_chunk().unwrap());
    let mut seeds = sound(prefix, entity, &Type::Imu.message(1).cdr());
    // The same from a stranger, and what a real participant says when it introduces itself.
    seeds.extend(sound([0x77; 12], entity, &Type::Imu.message(1).cdr()));
    seeds.extend(vec![announcement; 10]);
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let (socket, mut sent) = (UdpSocket::bind("127.0.0.1:0")?, 0);
    while sent < 1000 {
        let packet = broken(&seeds[random.below(seeds.len())], &mut random);
        for port in &ports {
            socket.send_to(&packet, ("127.0.0.1", *port))?;
        }
        sent += 1;
    }
    // Whoever has a writer's name can speak for it, and may have told that nothing comes any more.
    // Others are heard.
    drop(victim);
    still_heard(&mut dds)?;
    let after = memory_kib()?;
    println!(
        "{sent} broken packets to each of {} ports; memory at most {before}, then {after} KiB",
        ports.len()
    );
    if let Some(dead) = dds.health().dead {
        return Err(format!("good messages arrive, but we are said to be dead: {dead}").into());
    }
    if after - before > MEMORY_KIB {
        return Err(format!("memory rose from {before} to {after} KiB").into());
    }
    Ok(())
}

/// Fragments of 500 messages that claim so much each, for a reader of ours and for one that every
/// participant has.
fn claims(size: u32) -> Result<(), Failed> {
    let mut dds = join(None)?;
    let ports = udp_ports()?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let victim = Peer::start(Kind::Cyclone.publisher(Type::Imu, "/sensor", "--count 0 --rate 100"));
    let writer =
        heard.wait("a writer to speak for", |samples| samples.len() >= 20)?[0].meta.writer.0;
    let before = memory_kib()?;
    let (prefix, entity): ([u8; 12], Entity) =
        (*writer.first_chunk().unwrap(), *writer.last_chunk().unwrap());
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
    still_heard(&mut dds)?;
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

/// Somebody new writes on a new topic, and every message of it arrives.
fn still_heard(dds: &mut Dds) -> Result<(), Failed> {
    let heard = Heard::on(dds, Type::TimeReference, "/after", Qos::Auto)?;
    let options = "--count 200 --rate 200";
    let _peer = Peer::start(Kind::Cyclone.publisher(Type::TimeReference, "/after", options));
    heard.all(dds, 200)
}

/// The ports of all sockets in this network: called while only we have some.
pub fn udp_ports() -> Result<Vec<u16>, Failed> {
    let table = std::fs::read_to_string("/proc/self/net/udp")?;
    let port = |line: &str| {
        u16::from_str_radix(line.split_whitespace().nth(1)?.split_once(':')?.1, 16).ok()
    };
    let mut ports: Vec<u16> = table.lines().skip(1).filter_map(port).collect();
    ports.sort_unstable();
    ports.dedup();
    if ports.len() < 2 { Err(format!("we have no sockets: {table}").into()) } else { Ok(ports) }
}

/// What a participant says when it introduces itself, in the name of one that does not exist.
///
/// Ours is sent to the first ports that others on this machine might have: a plain socket on one of
/// those hears it.
pub fn announcement(ours: &[u16]) -> Result<Vec<u8>, Failed> {
    // DDSI-RTPS 2.3, section 9.6.1: unicast discovery in domain 0 is at 7410 and two more for each
    // participant.
    let sockets =
        (1..12).map(|participant| 7410 + 2 * participant).filter(|port| !ours.contains(port));
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
    match usage::most_resident() {
        0 => Err("the system does not tell how much memory we have".into()),
        bytes => Ok(bytes >> 10),
    }
}
