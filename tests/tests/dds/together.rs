//! Gleaner beside nodes of others: several of its participants read one topic, or its runs start
//! and stop; writers keep running, and readers receive each sample.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};

use gleaner_dds::Dds;
use gleaner_messages::transport::Qos;
use gleaner_protocol::Report;
use gleaner_tests::live::{cpu_ns, run, run_all};
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{Peer, PeerEvent, PeerKind};
use gleaner_tests::{LambdaCopy, TempFolder, root, times};
use libtest_mimic::Failed;

use crate::faults::{announcement, udp_ports};
use crate::receiver::{TopicReceiver, join};
use crate::{DdsCase, Need, case};

pub const CASES: &[DdsCase] = &[
    case("fast_dds_survives_several_readers_of_its_topic", &[Need::Peer(PeerKind::Fast)], || {
        survives(PeerKind::Fast)
    }),
    case("cyclone_survives_several_readers_of_its_topic", &[Need::Peer(PeerKind::Cyclone)], || {
        survives(PeerKind::Cyclone)
    }),
    case(
        "nodes_of_both_kinds_run_on_without_a_loss_while_runs_start_and_stop",
        &[Need::Peer(PeerKind::Cyclone), Need::Peer(PeerKind::Fast)],
        starts_and_stops,
    ),
    case("no_multicast_address_is_announced_for_samples", &[], || {
        announces_no_multicast(|| join(None))
    }),
    case("no_multicast_address_is_announced_by_a_python_lambda", &[], || {
        let out = TempFolder::new();
        announces_no_multicast(|| {
            let lambda =
                run(&root().join("tests/lambdas/ticker/python"), out.path(), &["--no-record"]);
            lambda.until_ready();
            Ok(lambda)
        })
    }),
];

const TOPIC: &str = "/sensor";
const READERS: [usize; 4] = [2, 5, 2, 5];
const SAMPLES: usize = 10;

/// DDSI-RTPS 2.2, section 9.6.2.2.2: parameters of an announcement.
const METATRAFFIC_MULTICAST_LOCATOR: u16 = 0x0033;
const DEFAULT_MULTICAST_LOCATOR: u16 = 0x0048;

fn survives(kind: PeerKind) -> Result<(), Failed> {
    let publisher = || Peer::start(kind.publisher(MessageType::Imu, TOPIC, "--count 0 --rate 100"));
    let mut early = publisher();
    for readers in READERS {
        let mut participants =
            (0..readers).map(|_| join(None)).collect::<Result<Vec<Dds>, Failed>>()?;
        let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
        let subscribe = |dds: &mut Dds| TopicReceiver::new(dds, MessageType::Imu, TOPIC, qos);
        let mut receivers = participants
            .iter_mut()
            .map(subscribe)
            .collect::<Result<Vec<TopicReceiver>, Failed>>()?;
        receives(&mut early, &receivers)?;
        // A writer may send to a single reader differently than to several.
        participants.truncate(1);
        receivers.truncate(1);
        receives(&mut early, &receivers)?;
    }
    let mut participants = [join(None)?, join(None)?];
    let subscribe = |dds: &mut Dds| TopicReceiver::new(dds, MessageType::Imu, TOPIC, Qos::Auto);
    let receivers =
        participants.iter_mut().map(subscribe).collect::<Result<Vec<TopicReceiver>, Failed>>()?;
    receives(&mut early, &receivers)?;
    drop(early);
    receives(&mut publisher(), &receivers)
}

/// Waits until each receiver has received more, or the writer has ended.
fn receives(writer: &mut Peer, receivers: &[TopicReceiver]) -> Result<(), Failed> {
    for receiver in receivers {
        let enough = receiver.count() + SAMPLES;
        let mut ended = None;
        drop(receiver.wait("samples", |samples| {
            ended = writer.ended();
            ended.is_some() || samples.len() >= enough
        })?);
        if let Some(how) = ended {
            return Err(format!("the writer ended with several readers: {how}").into());
        }
    }
    Ok(())
}

/// A reader of another program, and its newest sample.
struct NodeReader {
    peer: Peer,
    newest: Option<u32>,
    received: u32,
    lost: u32,
}

impl NodeReader {
    fn receive(&mut self, count: usize) -> Result<(), Failed> {
        for _ in 0..count {
            let seq = self.peer.wait("a sample", seq_of)?;
            self.add(seq);
        }
        Ok(())
    }

    fn add(&mut self, seq: u32) {
        self.received += 1;
        self.lost += self.newest.map_or(0, |newest| seq - newest - 1);
        self.newest = Some(seq);
    }
}

fn seq_of(event: PeerEvent) -> Option<u32> {
    if let PeerEvent::Sample { seq, .. } = event { Some(seq) } else { None }
}

const LAMBDAS: usize = 10;

/// Writers and readers on Cyclone DDS and Fast DDS, which read each other, while runs of several
/// lambdas start and stop. Prints the CPU time of these nodes without and beside Gleaner.
fn starts_and_stops() -> Result<(), Failed> {
    let topics = [(PeerKind::Cyclone, "/cyclone"), (PeerKind::Fast, "/fast")];
    let lambdas: Vec<LambdaCopy> = (0..LAMBDAS)
        .map(|index| {
            let (_, topic) = topics[index % 2];
            let lambda = format!("tests/lambdas/ticker/{}", ["rust", "python"][index / 2 % 2]);
            let on_topic = |manifest: String| {
                let on_topic = manifest.replace("/imu/data", topic);
                // A busy machine meets it.
                on_topic.replace("[limits]", "[limits]\ndeadline = \"5s\"")
            };
            LambdaCopy::changed_and_named(&lambda, &format!("ticker-{index}"), on_topic)
        })
        .collect();
    let folders: Vec<&Path> = lambdas.iter().map(LambdaCopy::path).collect();
    let start = |(kind, topic): (PeerKind, &str)| {
        Peer::start(kind.publisher(MessageType::Imu, topic, "--count 0 --rate 100"))
    };
    let mut writers = topics.map(start);
    let mut readers: Vec<NodeReader> = topics
        .iter()
        .flat_map(|(_, topic)| topics.map(|(kind, _)| (kind, *topic)))
        .map(|(kind, topic)| NodeReader {
            peer: Peer::start(kind.subscriber(MessageType::Imu, topic, "")),
            newest: None,
            received: 0,
            lost: 0,
        })
        .collect();
    for reader in &mut readers {
        reader.receive(SAMPLES)?;
    }
    let cpu = |writers: &[Peer], readers: &[NodeReader]| {
        let all = writers.iter().chain(readers.iter().map(|reader| &reader.peer));
        (Instant::now(), all.map(|peer| cpu_ns(peer.pid())).collect::<Vec<u64>>())
    };
    let mut looks = vec![cpu(&writers, &readers)];
    for reader in &mut readers {
        reader.receive(50 * SAMPLES)?;
    }
    looks.push(cpu(&writers, &readers));
    let starts = times("GLEANER_STARTS", 2);
    for _ in 0..starts {
        run_until_samples(&folders)?;
    }
    looks.push(cpu(&writers, &readers));
    for (writer, (kind, _)) in writers.iter_mut().zip(topics) {
        if let Some(how) = writer.ended() {
            return Err(format!("the writer on {kind:?} ended: {how}").into());
        }
    }
    for reader in &mut readers {
        while let Some(seq) = reader.peer.wait_for(Duration::ZERO, seq_of) {
            reader.add(seq);
        }
        // It still receives.
        reader.receive(SAMPLES)?;
        println!("{} samples received by a node, {} lost", reader.received, reader.lost);
        if reader.lost > 0 {
            return Err(format!("{} samples are missing in a node", reader.lost).into());
        }
    }
    for (between, what) in looks.windows(2).zip(["without Gleaner", "beside it"]) {
        let [(began, before), (ended, after)] = between else { continue };
        let span = ended.duration_since(*began).as_nanos() as f64;
        let shares = before.iter().zip(after).map(|(before, after)| {
            let used = after.saturating_sub(*before) as f64;
            format!("{:.2} %", 100.0 * used / span)
        });
        let shares = shares.collect::<Vec<_>>().join(", ");
        println!("{what}, {:.0} s: writers and readers on a core: {shares}", span / 1e9);
    }
    println!("{starts} starts of {LAMBDAS} lambdas");
    Ok(())
}

/// Starts a run of the lambdas, and stops it when each has received samples.
fn run_until_samples(lambdas: &[&Path]) -> Result<(), Failed> {
    let out = TempFolder::new();
    let run = run_all(lambdas, out.path(), &["--no-record"]);
    let mut receiving = BTreeSet::new();
    run.until_named("samples in all lambdas", |name, report| {
        if let Report::Live(live) = report
            && live.topics[0].received > 0
        {
            receiving.insert(name);
        }
        (receiving.len() == lambdas.len()).then_some(())
    });
    let finished = run.interrupt();
    match finished.status.success() {
        true => Ok(()),
        false => Err(format!("{}: {}", finished.status, finished.stderr).into()),
    }
}

/// Checks the announcement of the only participant in this network, which lives as long as the
/// result of `start`.
fn announces_no_multicast<T>(start: impl FnOnce() -> Result<T, Failed>) -> Result<(), Failed> {
    let _participant = start()?;
    let packet = announcement(&udp_ports()?)?;
    let announces = |parameter: u16| {
        // A locator has 24 bytes.
        let [low, high] = parameter.to_le_bytes();
        packet.windows(4).any(|bytes| bytes == [low, high, 24, 0])
    };
    match (announces(METATRAFFIC_MULTICAST_LOCATOR), announces(DEFAULT_MULTICAST_LOCATOR)) {
        (true, false) => Ok(()),
        (discovery, samples) => Err(format!(
            "multicast is announced for discovery: {discovery}, for samples: {samples}"
        )
        .into()),
    }
}
