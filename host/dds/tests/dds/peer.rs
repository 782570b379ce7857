//! Test peers: a participant of plain RustDDS, and sinks that keep samples.

use std::convert::Infallible;
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use bytes::Bytes;
use gleaner_dds::{Dds, DdsOptions};
use gleaner_messages::transport::{
    Clock, Delivery, Qos, ReceptionStatus, SampleMeta, Sink, Subscription, TopicSpec, Transport,
};
use rustdds::no_key::{
    DataWriter, Decode, DeserializerAdapter, SerializerAdapter, SimpleDataReader,
};
use rustdds::policy::{Durability, History, Reliability};
use rustdds::{
    DataWriterStatus, DomainParticipant, QosPolicies, QosPolicyBuilder, RepresentationIdentifier,
    StatusEvented, Topic, TopicKind,
};

/// Deadline for anything that is expected to happen.
pub const DEADLINE: Duration = Duration::from_secs(60);

/// A domain that no other test has.
pub fn domain() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

pub fn options(domain: u16) -> DdsOptions {
    DdsOptions {
        domain,
        largest: 1 << 20,
        clock: Clock::new(0),
        ..DdsOptions::new("/gleaner/test")
    }
}

pub fn open_in(domain: u16) -> Dds {
    Dds::open(options(domain)).unwrap()
}

/// A participant in a domain of its own.
pub fn open() -> (u16, Dds) {
    let domain = domain();
    (domain, open_in(domain))
}

pub fn spec(topic: &str, qos: Qos) -> TopicSpec {
    let type_name = "std_msgs/msg/String".to_owned();
    TopicSpec { topic: topic.to_owned(), type_name, queue: 10, max_bytes: 1 << 20, qos }
}

pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !done() {
        assert!(begun.elapsed() < DEADLINE, "{what}: not within {DEADLINE:?}");
        thread::sleep(Duration::from_millis(2));
    }
}

/// Waits for this number of writers.
pub fn connected(dds: &Dds, subscription: Subscription, writers: usize) -> ReceptionStatus {
    until("writers", || dds.status(subscription).writers == Some(writers));
    dds.status(subscription)
}

pub fn policies(reliable: bool, transient_local: bool) -> QosPolicies {
    let max_blocking_time = rustdds::Duration::from_secs(10);
    let reliability = if reliable {
        Reliability::Reliable { max_blocking_time }
    } else {
        Reliability::BestEffort
    };
    let durability =
        if transient_local { Durability::TransientLocal } else { Durability::Volatile };
    let history = History::KeepLast { depth: 100 };
    QosPolicyBuilder::new().reliability(reliability).durability(durability).history(history).build()
}

/// A participant of plain RustDDS.
pub struct Peer(pub DomainParticipant);

pub type LittleWriter = DataWriter<Bytes, Little>;

impl Peer {
    pub fn join(domain: u16) -> Self {
        Self(DomainParticipant::new(domain).unwrap())
    }

    fn topic(&self, name: &str, type_name: &str, policies: &QosPolicies) -> Topic {
        self.0
            .create_topic(name.to_owned(), type_name.to_owned(), policies, TopicKind::NoKey)
            .unwrap()
    }

    pub fn writer_of<A: SerializerAdapter<Bytes>>(
        &self,
        topic: &str,
        type_name: &str,
        policies: &QosPolicies,
    ) -> DataWriter<Bytes, A> {
        let topic = self.topic(topic, type_name, policies);
        let publisher = self.0.create_publisher(policies).unwrap();
        publisher.create_datawriter_no_key(&topic, Some(policies.clone())).unwrap()
    }

    /// A writer of `std_msgs/msg/String`.
    pub fn writer(&self, topic: &str, reliable: bool, transient_local: bool) -> LittleWriter {
        let policies = policies(reliable, transient_local);
        self.writer_of(&format!("rt{topic}"), "std_msgs::msg::dds_::String_", &policies)
    }

    pub fn reader(
        &self,
        topic: &str,
        type_name: &str,
        policies: &QosPolicies,
    ) -> SimpleDataReader<Vec<u8>, Little> {
        let topic = self.topic(topic, type_name, policies);
        let subscriber = self.0.create_subscriber(policies).unwrap();
        subscriber.create_simple_datareader_no_key(&topic, Some(policies.clone())).unwrap()
    }
}

/// The next sample, if there is one.
pub fn take(reader: &SimpleDataReader<Vec<u8>, Little>) -> Option<Vec<u8>> {
    reader.drain_read_notifications();
    reader.try_take_one_with(Whole).unwrap().map(|change| change.into_value())
}

/// A subscription, and a peer that has joined the domain after it.
pub struct Subscribed {
    pub domain: u16,
    pub dds: Dds,
    pub sink: Arc<KeptSamples>,
    pub subscription: Subscription,
    pub peer: Peer,
}

pub fn subscribed(topic: &str, qos: Qos) -> Subscribed {
    let (domain, mut dds) = open();
    let sink = KeptSamples::new();
    let subscription = dds.subscribe(&spec(topic, qos), sink.clone()).unwrap();
    Subscribed { domain, dds, sink, subscription, peer: Peer::join(domain) }
}

/// Waits until a writer is matched; samples written before are not sent to that reader.
pub fn matched<A: SerializerAdapter<Bytes>>(writer: &DataWriter<Bytes, A>) {
    until("a reader", || {
        matches!(writer.try_recv_status(), Some(DataWriterStatus::PublicationMatched { .. }))
    });
}

/// Writes a sample of a multiple of four bytes, which RTPS does not pad.
pub fn write<A: SerializerAdapter<Bytes>>(writer: &DataWriter<Bytes, A>, bytes: &[u8]) {
    assert_eq!(bytes.len() % 4, 0);
    writer.write(Bytes::copy_from_slice(bytes), None).unwrap();
}

macro_rules! adapters {
    ($($name:ident = $encoding:ident),*) => {$(
        pub struct $name;
        impl SerializerAdapter<Bytes> for $name {
            type Error = Infallible;
            fn output_encoding() -> RepresentationIdentifier {
                RepresentationIdentifier::$encoding
            }
            fn to_bytes(value: &Bytes) -> Result<Bytes, Infallible> {
                Ok(value.clone())
            }
        }
    )*};
}
adapters!(Little = CDR_LE, Big = CDR_BE, Parameters = PL_CDR_LE);

impl DeserializerAdapter<Vec<u8>> for Little {
    type Error = Infallible;
    type Decoded = Vec<u8>;
    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE]
    }
    fn transform_decoded(bytes: Vec<u8>) -> Vec<u8> {
        bytes
    }
}

#[derive(Clone)]
pub struct Whole;

impl<'de> Decode<'de, Vec<u8>> for Whole {
    type Error = Infallible;
    fn decode_bytes(
        self,
        bytes: &'de [u8],
        _: RepresentationIdentifier,
    ) -> Result<Vec<u8>, Infallible> {
        Ok(bytes.to_vec())
    }
}

#[derive(Default)]
pub struct KeptSamples {
    samples: Mutex<Vec<(SampleMeta, Vec<u8>)>>,
    arrived: Condvar,
}

impl Sink for KeptSamples {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.samples.lock().unwrap().push((*meta, cdr.to_vec()));
        self.arrived.notify_all();
        Delivery::Taken
    }
}

impl KeptSamples {
    pub fn new() -> Arc<Self> {
        Arc::default()
    }

    /// Waits for `count` samples, and returns all there are.
    pub fn wait(&self, count: usize) -> Vec<(SampleMeta, Vec<u8>)> {
        let samples = self.samples.lock().unwrap();
        let (samples, late) = self
            .arrived
            .wait_timeout_while(samples, DEADLINE, |samples| samples.len() < count)
            .unwrap();
        assert!(!late.timed_out(), "{} of {count} samples arrived", samples.len());
        samples.clone()
    }

    /// Waits for `count` samples, and returns the bytes of all there are.
    pub fn bytes(&self, count: usize) -> Vec<Vec<u8>> {
        self.wait(count).into_iter().map(|(_, bytes)| bytes).collect()
    }

    /// Publishes `mark` until it arrives: by then everything from before has arrived or never will.
    pub fn mark(&self, writer: &LittleWriter, mark: &[u8]) {
        until("a sample", || {
            write(writer, mark);
            self.samples.lock().unwrap().iter().any(|(_, bytes)| bytes == mark)
        });
    }
}
