//! Tests of the schedule over a transport that the test feeds directly. Ticks over a drive are
//! tested in `tests/tests/programs/schedule.rs`.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use gleaner_host::api::data::{Sample, Topic, Wake};
use gleaner_host::input::open_inputs;
use gleaner_host::schedule::WakeSchedule;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_tests::drive::TICKER_IMU;
use gleaner_tests::root;

use crate::meta;

const MS: i64 = 1_000_000;

/// An event input, and the transport that feeds it.
struct EventFeed {
    transport: Loopback,
    topic: Arc<Topic>,
    schedule: WakeSchedule,
    sent: u64,
}

impl EventFeed {
    /// An input that shows `depth` samples of up to `max_size`; one more can be held.
    fn new(backlog: &str, depth: usize, max_size: &str) -> Self {
        let manifest = format!(
            "[lambda]\nname = \"fed\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"fed.wasm\"\n\
             [schedule]\nevent = \"imu\"\nbacklog = \"{backlog}\"\n\
             [[input]]\nname = \"imu\"\ntopic = \"/imu/data\"\ntype = \"sensor_msgs/msg/Imu\"\n\
             depth = {depth}\nhold = 1\nmax_size = \"{max_size}\"\n"
        );
        let manifest = Manifest::parse(&manifest, "lambda.toml").unwrap();
        let mut transport = Loopback::new();
        transport.add_topic("/imu/data", "sensor_msgs/msg/Imu", TICKER_IMU);
        let inputs = open_inputs(&manifest, &[], &mut transport).unwrap();
        Self {
            transport,
            topic: Arc::clone(&inputs[0]),
            schedule: WakeSchedule::new(&manifest, &inputs),
            sent: 0,
        }
    }

    /// Publishes `samples` samples, numbered from 1.
    fn publish(&mut self, samples: u64) {
        for _ in 0..samples {
            self.sent += 1;
            send(&mut self.transport, self.sent, &[0; 64]);
        }
    }

    fn next(&mut self) -> Option<Sample> {
        self.schedule.next_event().map(sample)
    }

    /// Numbers of the samples that cause wakes, until there is none.
    fn wakes(&mut self) -> Vec<u64> {
        std::iter::from_fn(|| self.next()).map(|sample| sample.identity().seq).collect()
    }

    fn skipped(&self) -> u64 {
        self.topic.counts().skipped
    }
}

fn send(transport: &mut Loopback, seq: u64, cdr: &[u8]) {
    let at_ns = seq as i64 * MS;
    transport.publish("/imu/data", &meta(at_ns, seq), cdr).unwrap();
}

fn sample(wake: Wake) -> Sample {
    match wake {
        Wake::Event(sample) => sample,
        Wake::Tick(tick) => panic!("{tick:?} without a period"),
    }
}

#[test]
fn each_sample_wakes_once_and_in_order() {
    let mut feed = EventFeed::new("each", 4, "4 KiB");
    assert!(feed.wakes().is_empty());
    feed.publish(3);
    assert_eq!(feed.wakes(), [1, 2, 3]);
    assert!(feed.wakes().is_empty());
    feed.publish(2);
    assert_eq!((feed.wakes(), feed.skipped()), (vec![4, 5], 0));
}

#[test]
fn samples_that_leave_the_ring_before_their_wake_are_counted_as_skipped() {
    let mut feed = EventFeed::new("each", 4, "4 KiB");
    feed.publish(10);
    assert_eq!((feed.wakes(), feed.skipped()), (vec![7, 8, 9, 10], 6));
}

#[test]
fn the_latest_sample_wakes_once_and_those_before_it_are_counted_as_skipped() {
    let mut feed = EventFeed::new("latest", 4, "4 KiB");
    feed.publish(3);
    assert_eq!((feed.wakes(), feed.skipped()), (vec![3], 2));
    assert!(feed.wakes().is_empty());
    feed.publish(10);
    assert_eq!((feed.wakes(), feed.skipped()), (vec![13], 11));
}

#[test]
fn a_period_is_not_woken_by_samples_and_an_event_not_by_time() {
    let mut feed = EventFeed::new("each", 4, "4 KiB");
    feed.publish(1);
    assert!(feed.schedule.next_tick(i64::MAX).is_none());
    assert_eq!(feed.schedule.missed(), 0);
    let manifest = Manifest::load(root().join("tests/lambdas/ticker/rust")).unwrap();
    assert!(WakeSchedule::new(&manifest, &[]).next_event().is_none());
}

#[test]
fn a_lambda_that_holds_every_sample_wakes_for_none_twice_and_for_newer_ones_after_release() {
    for backlog in ["each", "latest"] {
        let mut feed = EventFeed::new(backlog, 2, "4 KiB");
        let mut held = Vec::new();
        for _ in 0..10 {
            feed.publish(1);
            held.extend(feed.next());
        }
        let seqs: Vec<_> = held.iter().map(|sample| sample.identity().seq).collect();
        let counts = feed.topic.counts();
        assert_eq!(seqs, (1..=counts.received).collect::<Vec<_>>(), "{backlog}");
        assert_eq!((counts.received + counts.no_slot, counts.skipped), (10, 0), "{backlog}");
        assert!(counts.no_slot > 0, "{backlog}");
        held.clear();
        feed.publish(1);
        assert_eq!((feed.wakes(), feed.skipped()), (vec![11], 0), "{backlog}");
    }
}

#[test]
fn no_sample_wakes_twice_or_after_a_newer_one_while_the_ring_reuses_released_slots() {
    const DEPTH: u64 = 64;
    for backlog in ["each", "latest"].repeat(4) {
        let mut feed = EventFeed::new(backlog, DEPTH as usize, "1 MiB");
        let mut held = Vec::new();
        // All slots but one are held, so each sample overwrites the previous one. Meanwhile the
        // newest visible sample is one that has caused a wake.
        while feed.topic.counts().no_slot == 0 {
            feed.publish(1);
            held.extend(feed.next());
        }
        held.pop();
        let (first, received) = (feed.sent + 1, feed.topic.counts().received);
        let mut transport = std::mem::take(&mut feed.transport);
        let writer = thread::spawn(move || {
            let cdr = vec![0; 1 << 20];
            (first..first + DEPTH).for_each(|seq| send(&mut transport, seq, &cdr));
        });
        let mut seqs = Vec::new();
        while !writer.is_finished() {
            seqs.extend(feed.next().map(|sample| sample.identity().seq));
            // A wake takes time, in which samples come and go.
            thread::sleep(Duration::from_micros(50));
        }
        writer.join().unwrap();
        seqs.extend(feed.wakes());
        assert!(seqs.first().is_some_and(|seq| *seq >= first), "{backlog}: {seqs:?}");
        assert!(seqs.is_sorted_by(|a, b| a < b), "{backlog}: {seqs:?}");
        // Each received sample has caused a wake, or is counted.
        let counts = feed.topic.counts();
        assert_eq!(seqs.len() as u64 + counts.skipped, counts.received - received, "{backlog}");
    }
}
