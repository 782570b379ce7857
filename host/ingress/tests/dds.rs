//! An ingress over DDS, with a publisher in the same process, in a network namespace.

use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use gleaner_dds::{Dds, DdsOptions, Distro};
use gleaner_ingress::Ingress;
use gleaner_messages::transport::{LiveSource, StoredMeta};
use gleaner_protocol::ingress::{
    AddReader, IngressControl, PinGrant, PublishGrant, Qos, TopicGrant,
};
use gleaner_samples::{Feed, SharedTopicReader};
use gleaner_test_support::network_namespace::{self, Test};

const TYPE: &str = "std_msgs/msg/Empty";
const TIMEOUT: Duration = Duration::from_secs(60);

fn main() -> ExitCode {
    let tests: [Test; 3] = [
        ("a_larger_subscription_takes_over_without_a_gap", takes_over),
        ("messages_of_a_reader_reach_other_nodes", publishes),
        ("a_reader_that_returns_gets_no_earlier_sample", returns),
    ];
    network_namespace::run_tests(tests, |(_, test)| test())
}

fn open(domain: u16, node: &str) -> Dds {
    let options = DdsOptions { domain, distro: Some(Distro::Newer), ..DdsOptions::new(node) };
    Dds::open(options).unwrap()
}

fn grant(id: u32, topic: &str, max_bytes: u64) -> TopicGrant {
    TopicGrant {
        id,
        topic: topic.to_owned(),
        type_name: Some(TYPE.to_owned()),
        qos: Qos::Fixed { reliable: true, transient_local: false, depth: 100 },
        queue: 100,
        max_bytes: Some(max_bytes),
        depth: 8192,
        holds: PinGrant { windows: 1, window: 8, singles: 4 },
        wakes: true,
        ..TopicGrant::default()
    }
}

fn attach(
    control: &mut IngressControl,
    name: &str,
    grant: TopicGrant,
) -> (Feed, SharedTopicReader) {
    let add = AddReader { name: name.to_owned(), topics: vec![grant], publishes: Vec::new() };
    let mut feed = Feed::connect(control.add_reader(&add).unwrap()).unwrap();
    let topic = feed.topic(0, TIMEOUT).unwrap();
    (feed, topic)
}

fn until(what: &str, mut is_it: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_it() {
        assert!(begun.elapsed() < TIMEOUT, "no {what} in time");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Returns the sequence numbers of all samples of a topic.
fn numbers(topic: &SharedTopicReader) -> Vec<u64> {
    let number = |position| {
        let sample = topic.reader.get(position).unwrap().expect("it is shown");
        StoredMeta::of_words(sample.meta()).sample.seq
    };
    (topic.info.first..topic.reader.head()).map(number).collect()
}

fn takes_over() {
    let (mut control, ingress) = Ingress::start_in_thread(Box::new(open(1, "/ingress")));
    let peer = open(1, "/peer");
    let writer = peer.writer("/number", TYPE, 4096).unwrap();
    let (_small_feed, small) = attach(&mut control, "small", grant(0, "/number", 64));
    until("match", || writer.readers() > 0);
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !stop.load(Ordering::Relaxed) {
                writer.write(&[1; 32]).unwrap();
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        until("first samples", || small.reader.head() > 100);
        let (_large_feed, large) = attach(&mut control, "large", grant(0, "/number", 200_000));
        until("match of the second subscription", || writer.readers() == 2);
        until("end of the first one", || writer.readers() == 1);
        let taken_over = large.reader.head();
        until("samples after that", || large.reader.head() > taken_over + 200);
        stop.store(true, Ordering::Relaxed);
        let sent = small.reader.head();
        until("same number of samples", || small.reader.head() >= sent);
        for topic in [&small, &large] {
            let numbers = numbers(topic);
            assert!(numbers.windows(2).all(|pair| pair[0] + 1 == pair[1]), "{numbers:?}");
            println!("{} samples without a gap", numbers.len());
        }
    });
    drop(control);
    ingress.join().unwrap();
}

fn publishes() {
    let (mut control, _ingress) = Ingress::start_in_thread(Box::new(open(2, "/ingress")));
    let (mut other_control, _other) = Ingress::start_in_thread(Box::new(open(2, "/other")));
    let (_feed, received) = attach(&mut other_control, "reads", grant(0, "/out", 64));
    let (topic, type_name) = ("/out".to_owned(), TYPE.to_owned());
    let publishes = vec![PublishGrant { topic, type_name, depth: 10, max_bytes: 64 }];
    let add = AddReader { name: "writes".to_owned(), topics: Vec::new(), publishes };
    let feed = Feed::connect(control.add_reader(&add).unwrap()).unwrap();
    let publisher = feed.publisher(0);
    until("message", || {
        publisher.publish(&[5; 12]).unwrap();
        received.reader.head() > 0
    });
    let newest = received.reader.newest_before(u64::MAX).unwrap().unwrap();
    assert_eq!(*newest, [5; 12]);
}

fn returns() {
    let source = open(3, "/ingress");
    assert!(!source.knows_all_topics());
    let (mut control, _ingress) = Ingress::start_in_thread(Box::new(source));
    let peer = open(3, "/peer");
    let writer = peer.writer("/number", TYPE, 4096).unwrap();
    let mut newest = 0;
    for _ in 0..5 {
        let (feed, topic) = attach(&mut control, "one", grant(0, "/number", 64));
        until("match", || writer.readers() == 1);
        until("samples", || {
            writer.write(&[1; 8]).unwrap();
            topic.reader.head() > 5
        });
        let numbers = numbers(&topic);
        assert!(numbers[0] > newest, "{} after {newest}", numbers[0]);
        newest = numbers[numbers.len() - 1];
        drop(feed);
        until("end of the subscription", || writer.readers() == 0);
    }
}
