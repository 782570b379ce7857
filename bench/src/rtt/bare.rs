//! The baseline: a bare RustDDS reader that only stamps and answers each sample, in one thread.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bytes::Bytes;
use gleaner_messages::CdrWriter;
use gleaner_messages::transport::Clock;
use mio::{Events, Interest, Poll, Token};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{
    DomainParticipantBuilder, QosPolicyBuilder, RepresentationIdentifier, Topic, TopicKind, no_key,
};

/// Receive buffer of its sockets, as of the ingress.
const BUFFER_BYTES: usize = 64 << 20;

/// Number of samples that it keeps. With more of them, the memory of images would never be reused.
const DEPTH: i32 = 16;

/// A thread that answers until it is stopped.
pub(super) struct BareReader {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl BareReader {
    /// Answers the samples of `input`, of a DDS type that begins with a header, on `output`.
    pub(super) fn start(input: &str, type_name: &str, output: &str) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (stop_flag, input, type_name, output) =
            (Arc::clone(&stop), format!("rt{input}"), type_name.to_owned(), format!("rt{output}"));
        let thread = thread::spawn(move || answer(&stop_flag, &input, &type_name, &output));
        Self { stop, thread }
    }

    /// Stops the thread.
    pub(super) fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the bare reader does not panic")
    }
}

fn answer(stop: &AtomicBool, input: &str, type_name: &str, output: &str) {
    let builder = DomainParticipantBuilder::new(0).socket_receive_buffer_size(BUFFER_BYTES);
    let participant = builder.build().expect("a private network can be joined");
    let limits =
        ResourceLimits { max_samples: DEPTH, max_instances: 1, max_samples_per_instance: DEPTH };
    let reliable = Reliability::Reliable { max_blocking_time: rustdds::Duration::from_millis(100) };
    let qos = QosPolicyBuilder::new()
        .reliability(reliable)
        .history(History::KeepLast { depth: DEPTH })
        .durability(Durability::Volatile)
        .resource_limits(limits)
        .build();
    let topic = |name: &str, type_name: &str| -> Topic {
        let topic =
            participant.create_topic(name.to_owned(), type_name.to_owned(), &qos, TopicKind::NoKey);
        topic.expect("a topic can be created")
    };
    let (input, output) =
        (topic(input, type_name), topic(output, "sensor_msgs::msg::dds_::TimeReference_"));
    let subscriber = participant.create_subscriber(&qos).expect("a subscriber can be created");
    let mut reader = subscriber
        .create_simple_datareader_no_key::<i64, StampAdapter>(&input, Some(qos.clone()))
        .expect("a reader can be created");
    let publisher = participant.create_publisher(&qos).expect("a publisher can be created");
    let writer =
        publisher.create_datawriter_no_key::<Bytes, StampAdapter>(&output, Some(qos.clone()));
    let writer = writer.expect("a writer can be created");
    let mut poll = Poll::new().expect("the system supports polling");
    poll.registry()
        .register(&mut reader, Token(0), Interest::READABLE)
        .expect("a reader can be polled");
    let mut events = Events::with_capacity(16);
    let (clock, mut message) = (Clock::new(0), CdrWriter::new());
    while !stop.load(Ordering::Relaxed) {
        // An interrupted poll is no reason to stop.
        let _ = poll.poll(&mut events, Some(Duration::from_millis(100)));
        reader.drain_read_notifications();
        while let Ok(Some(sample)) = reader.try_take_one_with(StampDecoder) {
            let stamp = sample.into_value();
            let now = clock.now();
            message.clear();
            message.time(stamp).string("").time(now).string("bare");
            let _ = writer.write(Bytes::copy_from_slice(message.bytes()), None);
        }
    }
}

struct StampAdapter;

impl no_key::DeserializerAdapter<i64> for StampAdapter {
    type Error = Infallible;
    type Decoded = i64;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE]
    }

    fn transform_decoded(stamp: i64) -> i64 {
        stamp
    }
}

impl no_key::SerializerAdapter<Bytes> for StampAdapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(cdr: &Bytes) -> Result<Bytes, Infallible> {
        Ok(cdr.clone())
    }
}

/// Decodes the stamp at the begin of a message with a header, in ns.
#[derive(Copy, Clone)]
struct StampDecoder;

impl<'de> no_key::Decode<'de, i64> for StampDecoder {
    type Error = Infallible;

    fn decode_bytes(self, cdr: &'de [u8], _: RepresentationIdentifier) -> Result<i64, Infallible> {
        let number = |at: usize| {
            cdr.get(at..at + 4)
                .and_then(|bytes| bytes.try_into().ok())
                .map_or(0, u32::from_le_bytes)
        };
        Ok(i64::from(number(0) as i32) * 1_000_000_000 + i64::from(number(4)))
    }
}
