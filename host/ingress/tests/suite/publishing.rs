//! Topics that readers publish.

use gleaner_protocol::ingress::PublishGrant;
use gleaner_samples::Feed;

use crate::support::{RunningIngress, TYPE, collect, grant, wait_for};

fn publish(topic: &str) -> PublishGrant {
    PublishGrant { topic: topic.to_owned(), type_name: TYPE.to_owned(), depth: 4, max_bytes: 64 }
}

#[test]
fn messages_of_a_reader_reach_the_source() {
    let (_, mut ingress) = RunningIngress::of_numbers("/out");
    let mut reading = ingress.reading("other", grant(0, "/out"));
    let feed = ingress.publisher("one", vec![publish("/no such topic"), publish("/out")]);
    for value in 1..=3 {
        feed.publisher(1).publish(&[value; 5]).unwrap();
    }
    let found = collect(3, || reading.new_samples());
    assert_eq!(found, [(1, vec![1; 5]), (2, vec![2; 5]), (3, vec![3; 5])]);
}

#[test]
fn messages_that_cannot_be_published_are_counted() {
    let (_, mut ingress) = RunningIngress::of_numbers("/out");
    let mut feed = ingress.publisher("one", vec![publish("/nowhere")]);
    for _ in 0..7 {
        feed.publisher(0).publish(&[1]).unwrap();
    }
    wait_for(|| {
        feed.poll().unwrap();
        (feed.status().unsent == 7).then_some(())
    });
}

#[test]
fn messages_that_are_too_long_are_counted_and_not_published() {
    let (_, mut ingress) = RunningIngress::of_numbers("/out");
    let mut reading = ingress.reading("other", grant(0, "/out"));
    let mut feed = ingress.publisher("one", vec![publish("/out")]);
    for len in [65, 64, 10_000] {
        feed.publisher(0).publish(&vec![1; len]).unwrap();
    }
    wait_for(|| {
        feed.poll().unwrap();
        (feed.status().unsent == 2).then_some(())
    });
    assert_eq!(reading.new_samples(), [(1, vec![1; 64])]);
}

#[test]
fn a_topic_that_was_not_granted_ends_the_connection() {
    let (_, mut ingress) = RunningIngress::of_numbers("/out");
    let mut feed = ingress.publisher("one", vec![publish("/out")]);
    let mut other = ingress.publisher("two", vec![publish("/out")]);
    feed.publisher(1).publish(&[1]).unwrap();
    wait_for(|| feed.poll().err());
    ingress.status(|status| status.readers == 1);
    assert!(other.poll().is_ok());
}

/// Publishes until the connection has no room; returns the number of messages.
fn flood(feed: &Feed, message: &[u8]) -> u64 {
    let publisher = feed.publisher(0);
    (0..).take_while(|_| publisher.publish(message).is_ok()).count() as u64
}

#[test]
fn a_flood_of_messages_is_slowed_down_at_its_origin() {
    let (_, mut ingress) = RunningIngress::of_numbers("/out");
    let mut reading = ingress.reading("other", grant(0, "/out"));
    let mut feed = ingress.publisher("hostile", vec![publish("/out")]);
    let mut sent = 0;
    // Many more than may be published in the time of the test.
    while sent < 5000 {
        sent += flood(&feed, &[1; 16]);
        feed.poll().unwrap();
        std::thread::yield_now();
        reading.next = reading.next.max(reading.topic.reader.head().saturating_sub(8));
        reading.new_samples();
    }
    let published = reading.topic.reader.head();
    assert!(published < sent, "{published} of {sent}");
    // Other readers are served meanwhile.
    let other = ingress.publisher("other publisher", vec![publish("/out")]);
    let before = reading.topic.reader.head();
    other.publisher(0).publish(&[2; 16]).unwrap();
    reading.next = before;
    wait_for(|| reading.new_samples().into_iter().find(|(_, bytes)| bytes[0] == 2));
    // Its end is seen although its socket is not read.
    drop(feed);
    ingress.status(|status| status.readers == 2);
}
