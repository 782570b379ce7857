//! Readers that outlive their ingress.

use std::os::unix::net::UnixStream;

use gleaner_messages::transport::StoredMeta;
use gleaner_protocol::Handover;
use gleaner_samples::{FeedEvent, ReconnectingReader, SharedTopicReader};

use crate::support::{RunningIngress, TEXT, TYPE, grant, wait_for};

#[test]
fn an_ingress_that_ended_before_it_was_joined_leaves_its_samples_to_the_reader() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let feed = ingress.reader("reader", vec![grant(0, "/number")]);
    let (starter, handover) = UnixStream::pair().unwrap();
    let mut feed = ReconnectingReader::new(feed, Some(handover.into()));
    let mut readings = vec![attached(&mut feed)];
    let mut published = numbers.publish_all(3);
    // The reader looks at neither of the next two before both have ended.
    for _ in 0..2 {
        drop(ingress);
        numbers.source.add_topic("/number", TYPE, TEXT);
        ingress = RunningIngress::over(numbers.source.clone());
        let socket = ingress.socket("reader", vec![grant(0, "/number").again(true)]);
        let passed = Handover { ingress: Some(socket), ..Handover::default() };
        passed.try_send(&starter).unwrap();
        ingress.status(|status| status.topics.iter().any(|topic| topic.readers == 1));
        published.extend(numbers.publish_all(3));
    }
    readings.push(attached(&mut feed));
    readings.push(attached(&mut feed));
    assert_eq!(readings.iter().flat_map(numbers_of).collect::<Vec<_>>(), published);
    assert_eq!((feed.connections(), feed.gaps().count), (2, 2));
}

/// Waits until the topic is attached.
fn attached(feed: &mut ReconnectingReader) -> SharedTopicReader {
    wait_for(|| {
        feed.poll().unwrap().into_iter().find_map(|event| match event {
            FeedEvent::Attached(topic) => Some(topic),
            _ => None,
        })
    })
}

/// Returns the sequence numbers of the samples of a topic.
fn numbers_of(topic: &SharedTopicReader) -> Vec<u64> {
    let positions = topic.info.first..topic.reader.head();
    let number = |position| {
        let sample = topic.reader.get(position).unwrap().unwrap();
        StoredMeta::of_words(sample.meta()).sample.seq
    };
    positions.map(number).collect()
}
