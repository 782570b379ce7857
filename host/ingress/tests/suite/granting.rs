//! Topics that are granted, refused, or found later.

use gleaner_feed::{Feed, FeedError, FeedEvent};
use gleaner_protocol::ingress::{AddReader, AddTopics, RefusedTopic, TopicGrant};
use gleaner_transport::loopback::Loopback;

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

#[test]
fn holds_beyond_the_control_page_are_refused() {
    let mut ingress = RunningIngress::over(Numbers::on("/number").source);
    let holds = |singles| gleaner_protocol::ingress::HoldGrant { windows: 0, window: 0, singles };
    let granted = |id, singles| TopicGrant { holds: holds(singles), ..grant(id, "/number") };
    let topics = vec![granted(0, 300), granted(1, 300), granted(2, 204), granted(3, 1)];
    let mut feed = ingress.reader("one", topics);
    assert_eq!(feed.topic(0, TIMEOUT).unwrap().info.first_word, 0);
    assert!(matches!(refusal(&mut feed, 1), RefusedTopic::Other(_)));
    assert_eq!(feed.topic(2, TIMEOUT).unwrap().info.first_word, 300);
    assert!(matches!(refusal(&mut feed, 3), RefusedTopic::Other(_)));
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
    assert_eq!(
        refusal(&mut feed, 0),
        RefusedTopic::Other(vec!["id 0 is granted twice".to_owned()])
    );
}

#[test]
fn definitions_are_answered_while_the_source_has_them() {
    let numbers = Numbers::on("/number");
    numbers.source.add_topic("/other", TYPE, "");
    let mut ingress = RunningIngress::over(numbers.source.clone());
    let mut feed = ingress.reader("one", vec![grant(0, "/number"), grant(1, "/other")]);
    feed.topic(0, TIMEOUT).unwrap();
    feed.topic(1, TIMEOUT).unwrap();
    assert_eq!(feed.definitions(0, TIMEOUT).unwrap().as_deref(), Some(TEXT));
    assert_eq!(feed.definitions(1, TIMEOUT).unwrap(), None);
    assert_eq!(feed.definitions(99, TIMEOUT).unwrap(), None, "it has no such topic");
}

#[test]
fn a_reader_sees_the_state_of_the_source() {
    let numbers = Numbers::on("/number");
    let mut ingress = RunningIngress::over(numbers.source.clone());
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
    let mut numbers = Numbers::on("/number");
    let mut ingress = RunningIngress::over(numbers.source.clone());
    for _ in 0..20 {
        let mut reading = ingress.reading("one", grant(0, "/number"));
        let sent = numbers.publish_all(3);
        assert_eq!(reading.new_numbers(), sent);
    }
    let add = AddReader { name: "one".to_owned(), topics: Vec::new(), publishes: Vec::new() };
    let _socket = ingress.control().add_reader(&add).unwrap();
    ingress.status(|status| status.readers == 1);
}
