//! Tests the in-process transport.

use std::sync::Arc;

use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{
    Delivery, Guid, SampleMeta, Subscription, Transport, TransportError,
};

use gleaner_test_support::drives::{MemorySink, TEXT, TYPE, spec};

fn meta(at_ns: i64) -> SampleMeta {
    SampleMeta::new(at_ns, Guid([7; 16]), 1)
}

#[test]
fn a_published_sample_reaches_every_subscription() {
    let mut loopback = Loopback::new();
    loopback.add_topic("/a", TYPE, TEXT);
    assert_eq!(loopback.publish("/a", &meta(0), &[0; 8]).unwrap(), None);
    let memory = Arc::new(MemorySink::default());
    assert_eq!(loopback.subscribe(&spec("/a"), memory.clone()).unwrap(), Subscription(0));
    assert_eq!(loopback.subscribe(&spec("/a"), memory.clone()).unwrap(), Subscription(1));
    let delivery = loopback.publish("/a", &meta(5), &9i64.to_le_bytes()).unwrap();
    assert_eq!(delivery, Some(Delivery::Taken));
    assert_eq!(memory.values(), [(5, 9), (5, 9)]);
    assert_eq!(loopback.topics()[0].messages, Some(2));
    assert_eq!(loopback.definitions("/a").unwrap().type_name(), TYPE);
}

#[test]
fn an_error_names_its_cause() {
    let mut loopback = Loopback::new();
    loopback.add_topic("/a", "other/Type", "");
    let memory = Arc::new(MemorySink::default());
    let wrong = loopback.subscribe(&spec("/a"), memory.clone()).unwrap_err();
    assert!(matches!(wrong, TransportError::WrongType { .. }));
    let absent = loopback.subscribe(&spec("/b"), memory).unwrap_err();
    assert!(matches!(absent, TransportError::NoSuchTopic { .. }));
    let bare = loopback.definitions("/a").unwrap_err();
    assert!(matches!(bare, TransportError::NoDefinitions { .. }));
}
