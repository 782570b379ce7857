//! Other nodes forget what has ended: readers, writers and participants, in order or killed. A
//! reliable writer that keeps all of its samples would wait for their acknowledgements.

use std::time::{Duration, Instant};

use gleaner_messages::transport::{LiveSource, Qos};
use gleaner_tests::live::{descendants, run, signal};
use gleaner_tests::peers::message::MessageType::Imu;
use gleaner_tests::peers::{Peer, PeerEvent, PeerKind};
use gleaner_tests::{LambdaCopy, TempFolder};
use libtest_mimic::Failed;

use crate::receiver::{TopicReceiver, join};
use crate::{DdsCase, Need, case};

const CYCLONE: &[Need] = &[Need::Peer(PeerKind::Cyclone)];
const FAST: &[Need] = &[Need::Peer(PeerKind::Fast)];

pub const CASES: &[DdsCase] = &[
    case("cyclone_forgets_readers_and_writers_that_end", CYCLONE, || ended(PeerKind::Cyclone)),
    case("fast_dds_forgets_readers_and_writers_that_end", FAST, || ended(PeerKind::Fast)),
    case("cyclone_forgets_a_killed_ingress", CYCLONE, || killed(PeerKind::Cyclone)),
    case("fast_dds_forgets_a_killed_ingress", FAST, || killed(PeerKind::Fast)),
];

const TOPIC: &str = "/sensor";
/// Far less than the lease of a participant, which is 50 s.
const FORGOTTEN: Duration = Duration::from_secs(10);

/// A writer that keeps all of its samples until they are acknowledged.
fn keeping_all(kind: PeerKind) -> Peer {
    Peer::start(kind.publisher(Imu, TOPIC, "--count 0 --rate 100 --depth 0"))
}

/// Waits until `left` endpoints are matched, and prints how long that took.
fn forgets(peer: &mut Peer, left: u32) -> Result<(), Failed> {
    let begin = Instant::now();
    let is_it = |event| (event == PeerEvent::Matched { count: left }).then_some(());
    peer.wait_for(FORGOTTEN, is_it).ok_or_else(|| {
        let ended = peer.ended();
        format!("it is not down to {left} within {FORGOTTEN:?}; the peer has ended: {ended:?}")
    })?;
    println!("down to {left} after {:.3} s", begin.elapsed().as_secs_f64());
    Ok(())
}

/// As [`forgets`], of a writer, whose other readers acknowledge all samples.
fn goes_on(writer: &mut Peer, left: u32) -> Result<(), Failed> {
    forgets(writer, left)?;
    acknowledged(writer)
}

/// Waits until the readers of a writer have acknowledged all samples.
fn acknowledged(writer: &mut Peer) -> Result<(), Failed> {
    let acked = |event| if let PeerEvent::Acked { all } = event { Some(all) } else { None };
    match writer.wait("acknowledgements", acked)? {
        true => Ok(()),
        false => Err("a reader does not acknowledge all samples".into()),
    }
}

fn ended(kind: PeerKind) -> Result<(), Failed> {
    let mut publisher = keeping_all(kind);
    let mut subscriber = Peer::start(kind.subscriber(Imu, "/output", ""));
    let mut dds = join(None)?;
    let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
    let first = TopicReceiver::new(&mut dds, Imu, TOPIC, qos)?;
    publisher.matched()?;
    let writer = dds.writer("/output", &Imu.name(), 10)?;
    subscriber.matched()?;
    // As for a lambda that asks for more than the first one, and ends.
    let second = TopicReceiver::new(&mut dds, Imu, TOPIC, qos)?;
    let is_second = |event| (event == PeerEvent::Matched { count: 2 }).then_some(());
    publisher.wait("a second reader", is_second)?;
    acknowledged(&mut publisher)?;
    dds.unsubscribe(second.subscription);
    goes_on(&mut publisher, 1)?;
    drop(writer);
    forgets(&mut subscriber, 0)?;
    let received = first.count();
    drop(first.wait("samples after that", |samples| samples.len() > received + 20)?);
    drop(dds);
    goes_on(&mut publisher, 0)
}

fn killed(kind: PeerKind) -> Result<(), Failed> {
    let mut publisher = keeping_all(kind);
    let on_topic = |manifest: String| manifest.replace("/imu/data", TOPIC);
    let lambda = LambdaCopy::of("tests/lambdas/ticker/rust", on_topic);
    let out = TempFolder::new();
    let run = run(lambda.path(), out.path(), &["--no-record"]);
    publisher.matched()?;
    let ingress = descendants(run.pid(), "gleaner-ingress");
    ingress.into_iter().for_each(|pid| signal(pid, "KILL"));
    goes_on(&mut publisher, 0)?;
    // The next ingress.
    publisher.matched()?;
    acknowledged(&mut publisher)?;
    drop(run.interrupt());
    goes_on(&mut publisher, 0)
}
