//! Several readers of one topic.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_messages::transport::{Delivery, Qos, StoredMeta, TopicCounters};
use gleaner_protocol::ingress::TopicGrant;

use crate::support::{RunningIngress, collect, grant, wait_for};

#[test]
fn every_reader_receives_every_sample_from_its_beginning() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut first = ingress.reading("first", grant(0, "/number"));
    let early = numbers.publish_all(5);
    let mut second = ingress.reading("second", grant(7, "/number"));
    assert_eq!((second.topic.info.first, second.topic.info.id), (5, 7));
    let late = numbers.publish_all(5);
    assert_eq!(second.new_numbers(), late);
    assert_eq!(first.new_numbers(), [early, late].concat());
    let status = ingress.status(|status| status.topics.iter().any(|topic| topic.readers == 2));
    let topic = &status.topics[0];
    assert_eq!((status.readers, status.topics.len(), topic.received), (2, 1, 10));
    assert_eq!((topic.topic.as_str(), topic.too_big), ("/number", 0));
}

#[test]
fn a_sample_that_is_too_big_for_one_reader_reaches_the_others() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut small = ingress.reading("small", grant(0, "/number"));
    let mut large =
        ingress.reading("large", TopicGrant { max_bytes: Some(1000), ..grant(0, "/number") });
    assert_eq!(numbers.publish(64), Some(Delivery::Taken));
    numbers.publish(65);
    numbers.publish(1000);
    numbers.publish(1001);
    numbers.publish(8);
    assert_eq!(small.new_numbers(), [1, 5]);
    assert_eq!(large.new_numbers(), [1, 2, 3, 5]);
    let counters = |words| TopicCounters::of_words(&words).too_big;
    assert_eq!(counters(small.topic.reader.counters()), 3);
    assert_eq!(counters(large.topic.reader.counters()), 1);
    let newest = small.topic.reader.newest_before(u64::MAX).unwrap().unwrap();
    assert_eq!(StoredMeta::of_words(newest.meta()).refused, 3);
    let status = ingress.status(|status| status.topics.iter().any(|topic| topic.received == 5));
    assert_eq!(status.topics[0].too_big, 3);
}

#[test]
fn digests_are_summed_while_a_reader_needs_them() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let digests = |reading: &crate::support::Reading| {
        let newest = reading.topic.reader.newest_before(u64::MAX).unwrap().unwrap();
        StoredMeta::of_words(newest.meta()).digests
    };
    let plain = ingress.reading("plain", grant(0, "/number"));
    numbers.publish(8);
    assert_eq!(digests(&plain), 0);
    let with_digests = TopicGrant { digests: true, ..grant(0, "/number") };
    let one = ingress.reading("one", with_digests.clone());
    assert_eq!(one.topic.info.digests, 0);
    numbers.publish(8);
    let after_one = digests(&one);
    assert_ne!(after_one, 0);
    let two = ingress.reading("two", with_digests);
    assert_eq!(two.topic.info.digests, after_one);
    ingress.status(|status| status.readers == 3);
    drop((one, two));
    ingress.status(|status| status.readers == 1);
    numbers.publish(8);
    assert_eq!(digests(&plain), 0);
}

#[test]
fn readers_come_and_go_without_loss_for_others() {
    const SAMPLES: u64 = 30_000;
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    // All samples stay: the reader may be slow.
    let mut steady =
        ingress.reading("steady", TopicGrant { depth: 1 << 16, ..grant(0, "/number") });
    let done = Arc::new(AtomicBool::new(false));
    let publishing = {
        let done = Arc::clone(&done);
        std::thread::spawn(move || {
            for n in 0..SAMPLES {
                numbers.publish(8 + n as usize % 50);
                std::thread::yield_now();
            }
            done.store(true, Ordering::Relaxed);
        })
    };
    let mut rounds = 0;
    while !done.load(Ordering::Relaxed) || rounds < 3 {
        // The same region, one for larger and one for smaller samples.
        for (name, max_bytes) in [("same", 64), ("large", 5000), ("small", 20)] {
            let mut reading = ingress
                .reading(name, TopicGrant { max_bytes: Some(max_bytes), ..grant(3, "/number") });
            let found = reading.new_numbers();
            assert!(max_bytes == 20 || found.windows(2).all(|pair| pair[0] + 1 == pair[1]));
            assert!(found.is_sorted());
        }
        rounds += 1;
    }
    publishing.join().unwrap();
    assert_eq!(steady.new_numbers(), (1..=SAMPLES).collect::<Vec<_>>());
    println!("{rounds} rounds of 3 readers beside {SAMPLES} samples");
    assert_eq!(ingress.end().topics[0].received, SAMPLES);
}

#[test]
fn a_later_reader_of_larger_samples_costs_the_others_nothing() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut small = ingress.reading("small", grant(0, "/number"));
    numbers.publish_all(3);
    let mut large =
        ingress.reading("large", TopicGrant { max_bytes: Some(100_000), ..grant(0, "/number") });
    // There are two subscriptions now: each sample is delivered twice.
    numbers.publish_all(3);
    numbers.publish(90_000);
    assert_eq!(small.new_numbers(), [1, 2, 3, 4, 5, 6]);
    assert_eq!(large.new_numbers(), [4, 5, 6, 7]);
    let before = ingress.status(|status| status.topics.iter().any(|topic| topic.received == 7));
    assert_eq!(before.topics[0].too_big, 1);
    // The first subscription ends some seconds later.
    for _ in 0..5 {
        numbers.publish(8);
        ingress.status(|_| true);
    }
    assert_eq!(small.new_numbers(), [8, 9, 10, 11, 12]);
    assert_eq!(large.new_numbers(), [8, 9, 10, 11, 12]);
}

#[test]
fn what_a_reader_held_is_free_after_its_end() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut other = ingress.reading("other", grant(0, "/number"));
    for round in 0..40 {
        let holder = ingress.reading(&format!("holder {round}"), grant(0, "/number"));
        let mut held = Vec::new();
        for _ in 0..4 {
            numbers.publish(8);
            held.push(holder.topic.reader.newest_before(u64::MAX).unwrap().unwrap());
        }
        let bytes: Vec<Vec<u8>> = held.iter().map(|sample| sample.to_vec()).collect();
        numbers.publish_all(500);
        assert!(held.iter().zip(&bytes).all(|(sample, bytes)| **sample == **bytes));
        // Its process is killed: nothing clears its hazards.
        drop(holder.feed);
        std::mem::forget(held);
    }
    // There is room for new readers in the same region.
    let status = ingress.status(|status| status.readers == 1);
    let reserved = status.topics[0].reserved_bytes;
    let again = ingress.reading("again", grant(0, "/number"));
    assert_eq!(again.topic.info.layout, other.topic.info.layout);
    let status = ingress.status(|status| status.readers == 2);
    assert_eq!(status.topics[0].reserved_bytes, reserved);
    other.next = other.topic.reader.head();
    let last = numbers.publish_all(3);
    assert_eq!(other.new_numbers(), last);
}

#[test]
fn a_region_without_room_for_more_holds_gets_a_second_one() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut readers: Vec<_> =
        (0..70).map(|n| ingress.reading(&format!("r{n}"), grant(0, "/number"))).collect();
    let all = numbers.publish_all(20);
    for reader in &mut readers {
        assert_eq!(reader.new_numbers(), all);
    }
    let deeper = TopicGrant { depth: 300, ..grant(0, "/number") };
    let mut deeper = ingress.reading("deeper", deeper);
    assert_eq!(deeper.topic.info.layout.depth, 512);
    let more = numbers.publish_all(400);
    assert_eq!(deeper.new_numbers().len(), 400);
    assert_eq!(readers[0].topic.reader.newest_before(u64::MAX).unwrap().unwrap()[0], 420_u64 as u8);
    let shown = readers[69].topic.reader.last_before(u64::MAX, 3).unwrap().unwrap();
    assert_eq!(shown.len(), 3);
    assert_eq!(more.len(), 400);
}

#[test]
fn a_later_reader_of_a_latched_topic_receives_what_is_shown() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/map");
    let qos = Qos::Fixed { reliable: true, transient_local: true, depth: 3 };
    let latched = TopicGrant { qos, depth: 2, ..grant(0, "/map") };
    let mut first = ingress.reading("first", latched.clone());
    numbers.publish_all(1);
    assert_eq!(first.new_numbers(), [1]);
    numbers.publish_all(2);
    assert_eq!(first.new_numbers(), [2, 3]);
    let mut second = ingress.reading("second", latched.clone());
    assert_eq!(second.new_numbers(), [2, 3]);
    // Another size has a region of its own.
    let larger = TopicGrant { max_bytes: Some(100), ..latched };
    let mut third = ingress.reading("third", larger);
    assert_eq!(third.new_numbers(), [2, 3]);
    numbers.publish(8);
    for reader in [&mut first, &mut second, &mut third] {
        assert_eq!(reader.new_numbers(), [4]);
    }
}

#[test]
fn a_sample_that_was_too_big_for_all_comes_again_for_a_larger_reader() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/map");
    let mut small = ingress.reading("small", grant(0, "/map"));
    numbers.publish(1000);
    let larger = TopicGrant { max_bytes: Some(1000), ..grant(0, "/map") };
    let mut large = ingress.reading("large", larger);
    // As a writer that is transient local sends it again to the second subscription.
    numbers.seq -= 1;
    numbers.publish(1000);
    numbers.publish(8);
    assert_eq!(large.new_numbers(), [1, 2]);
    assert_eq!(small.new_numbers(), [2]);
    let too_big = TopicCounters::of_words(&small.topic.reader.counters()).too_big;
    assert_eq!(too_big, 1, "it is counted once");
}

#[test]
fn a_topic_without_readers_is_unsubscribed() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let reading = ingress.reading("one", grant(0, "/number"));
    numbers.publish_all(2);
    ingress.status(|status| status.readers == 1);
    drop(reading);
    ingress.status(|status| status.readers == 0 && status.topics.is_empty());
    assert_eq!(numbers.publish(8), None, "there is no subscription");
    let mut again = ingress.reading("one", grant(0, "/number"));
    numbers.publish(8);
    assert_eq!(again.new_numbers(), [4]);
    assert_eq!(ingress.end().readers, 1);
}

#[test]
fn the_end_of_the_ingress_leaves_held_samples_as_they_are() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut reading = ingress.reading("one", grant(0, "/number"));
    numbers.publish(40);
    let held = reading.topic.reader.get(0).unwrap().unwrap();
    ingress.end();
    wait_for(|| reading.feed.poll().err());
    assert_eq!(*held, [1; 40]);
}

#[test]
fn a_sample_wakes_the_readers_that_wait_for_it() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut reading = ingress.reading("waits", grant(0, "/number"));
    let quiet = TopicGrant { wakes: false, ..grant(0, "/number") };
    let quiet = ingress.reading("quiet", quiet);
    let (mut bell, silent) = (reading.feed.bell(), quiet.feed.bell());
    let before = (bell.value(), silent.value());
    numbers.publish(8);
    let found = collect(1, || {
        bell.wait(before.0, crate::support::TIMEOUT);
        reading.new_numbers()
    });
    assert_eq!(found, [1]);
    assert_eq!(silent.value(), before.1);
}
