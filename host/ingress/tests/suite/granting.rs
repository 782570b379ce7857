//! Topics that are granted, refused, or found later.

use gleaner_buffers::shared::HAZARDS;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_protocol::ingress::{AddReader, AddTopics, PinGrant, RefusedTopic, TopicGrant};
use gleaner_samples::{Feed, FeedError, FeedEvent};

use crate::support::{Numbers, RunningIngress, TEXT, TIMEOUT, TYPE, grant, meta, wait_for};

fn refusal(feed: &mut Feed, id: u32) -> RefusedTopic {
    match feed.topic(id, TIMEOUT) {
        Err(FeedError::Refused { reason, .. }) => reason,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_topic_without_a_type_waits_for_a_writer() {
    let source = Loopback::new();
    let mut ingress = RunningIngress::over(source.clone());
    let untyped = TopicGrant { type_name: None, max_bytes: None, ..grant(4, "/late") };
    let mut feed = ingress.reader("recorder", vec![untyped]);
    assert!(feed.poll().unwrap().is_empty());
    source.add_topic("/late", TYPE, TEXT);
    let topic = feed.topic(4, TIMEOUT).unwrap();
    assert_eq!(topic.info.type_name, TYPE);
    assert_eq!(topic.info.definitions.as_deref(), Some(TEXT));
    assert_eq!(topic.info.layout.slot_bytes, 8 << 20, "the usual size");
    source.publish("/late", &meta(1), &[7; 100]).unwrap();
    assert_eq!(*topic.reader.get(0).unwrap().unwrap(), [7; 100]);
}

#[test]
fn refusals_name_the_topic_or_the_type() {
    let mut ingress = RunningIngress::over(Numbers::on("/number").source);
    let other = TopicGrant { type_name: Some("a/msg/B".to_owned()), ..grant(1, "/number") };
    let mut feed = ingress.reader("one", vec![grant(0, "/numbr"), other, grant(2, "/number")]);
    let known = vec!["/number".to_owned()];
    let nearest = Some("/number".to_owned());
    assert_eq!(refusal(&mut feed, 0), RefusedTopic::NoSuchTopic { known, nearest });
    assert_eq!(refusal(&mut feed, 1), RefusedTopic::WrongType { found: TYPE.to_owned() });
    assert!(feed.topic(2, TIMEOUT).is_ok(), "the others are attached");
    let status = ingress.status(|status| status.readers == 1);
    assert_eq!(status.topics.len(), 1);
}

/// Returns a grant of a topic with words for `singles` samples.
fn holding(id: u32, topic: &str, singles: u16) -> TopicGrant {
    TopicGrant { holds: PinGrant { windows: 0, window: 0, singles }, ..grant(id, topic) }
}

#[test]
fn holds_beyond_the_control_page_are_refused() {
    let mut ingress = RunningIngress::over(Numbers::on("/number").source);
    let (full, rest) = (HAZARDS / 2048, (HAZARDS % 2048) as u16);
    let mut topics: Vec<_> = (0..=full as u32).map(|id| holding(id, "/number", 2048)).collect();
    topics.extend([holding(1000, "/number", rest), holding(1001, "/number", 1)]);
    let mut feed = ingress.reader("one", topics);
    for id in 0..full as u32 {
        assert_eq!(feed.topic(id, TIMEOUT).unwrap().info.first_word, id * 2048);
    }
    assert!(matches!(refusal(&mut feed, full as u32), RefusedTopic::Other(_)));
    assert_eq!(feed.topic(1000, TIMEOUT).unwrap().info.first_word as usize, full * 2048);
    assert!(matches!(refusal(&mut feed, 1001), RefusedTopic::Other(_)));
}

/// A recorder has one word for each topic, and more topics than any lambda.
#[test]
fn a_reader_of_700_topics_holds_samples_of_each() {
    let source = Loopback::new();
    let topics: Vec<String> = (0..700).map(|number| format!("/number_{number}")).collect();
    topics.iter().for_each(|topic| source.add_topic(topic, TYPE, TEXT));
    let mut ingress = RunningIngress::over(source.clone());
    let grants = topics.iter().zip(0..).map(|(topic, id)| holding(id, topic, 1)).collect();
    let mut feed = ingress.reader("recorder", grants);
    let readers: Vec<_> = (0..700).map(|id| feed.topic(id, TIMEOUT).unwrap().reader).collect();
    for topic in &topics {
        source.publish(topic, &meta(1), topic.as_bytes()).unwrap();
    }
    let held: Vec<_> = readers.iter().map(|reader| reader.get(0).unwrap().unwrap()).collect();
    // More than all slots: only those that are held stay.
    for seq in 2..400 {
        source.publish(&topics[699], &meta(seq), b"later").unwrap();
    }
    assert!(held.iter().zip(&topics).all(|(sample, topic)| **sample == *topic.as_bytes()));
}

#[test]
fn memory_that_does_not_exist_is_refused() {
    let mut ingress = RunningIngress::over(Numbers::on("/number").source);
    let huge = TopicGrant { max_bytes: Some(1 << 30), depth: 131_072, ..grant(0, "/number") };
    let mut feed = ingress.reader("one", vec![huge, grant(1, "/number")]);
    let RefusedTopic::Other(why) = refusal(&mut feed, 0) else { panic!() };
    assert_eq!(why[0], "there is no memory for topic `/number`");
    assert!(feed.topic(1, TIMEOUT).is_ok());
}

#[test]
fn further_topics_are_granted_by_name() {
    let numbers = Numbers::on("/number");
    numbers.source.add_topic("/other", TYPE, "");
    let mut ingress = RunningIngress::over(numbers.source.clone());
    let mut feed = ingress.reader("one", vec![grant(0, "/number")]);
    let add = |reader: &str, grant| AddTopics { reader: reader.to_owned(), topics: vec![grant] };
    ingress.control().add_topics(&add("nobody", grant(1, "/other"))).unwrap();
    ingress.control().add_topics(&add("one", grant(1, "/other"))).unwrap();
    ingress.control().add_topics(&add("one", grant(0, "/other"))).unwrap();
    let info = feed.topic(1, TIMEOUT).unwrap().info;
    assert_eq!(info.definitions, None);
    assert_eq!(feed.topic(0, TIMEOUT).unwrap().info.id, 0);
    let twice = RefusedTopic::Other(vec!["id 0 is granted twice".to_owned()]);
    assert_eq!(refusal(&mut feed, 0), twice);
}

#[test]
fn definitions_are_answered_while_the_source_has_them() {
    let numbers = Numbers::on("/number");
    numbers.source.add_topic("/other", TYPE, "");
    let mut ingress = RunningIngress::over(numbers.source.clone());
    let mut feed = ingress.reader("one", vec![grant(0, "/number"), grant(1, "/other")]);
    feed.topic(0, TIMEOUT).unwrap();
    feed.topic(1, TIMEOUT).unwrap();
    for _ in 0..2 {
        assert_eq!(feed.definitions(0, TIMEOUT).unwrap().as_deref(), Some(TEXT));
    }
    assert_eq!(feed.definitions(0, TIMEOUT).unwrap(), None, "a reader keeps what it has");
    assert_eq!(feed.definitions(1, TIMEOUT).unwrap(), None);
    assert_eq!(feed.definitions(99, TIMEOUT).unwrap(), None, "it has no such topic");
}

#[test]
fn a_reader_sees_the_state_of_the_source() {
    let (numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut feed = ingress.reader("one", vec![grant(5, "/number")]);
    numbers.source.fail("it is unplugged");
    wait_for(|| {
        let events = feed.poll().unwrap();
        assert!(events.iter().all(|event| matches!(event, FeedEvent::Attached(_))));
        let status = feed.status();
        let is_it = status.health.dead.is_some() && status.topics.iter().any(|(id, _)| *id == 5);
        is_it.then_some(())
    });
    assert_eq!(feed.status().health.dead.as_deref(), Some("it is unplugged"));
}

#[test]
fn a_reader_that_is_restarted_has_the_same_name() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    for _ in 0..20 {
        let mut reading = ingress.reading("one", grant(0, "/number"));
        let sent = numbers.publish_all(3);
        assert_eq!(reading.new_numbers(), sent);
    }
    let add = AddReader { name: "one".to_owned(), topics: Vec::new(), publishes: Vec::new() };
    let _socket = ingress.control().add_reader(&add).unwrap();
    ingress.status(|status| status.readers == 1);
}
