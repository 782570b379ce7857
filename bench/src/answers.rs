//! Receives the answers that lambdas publish with `--rtt`: the time of each decision, its delay
//! after the sample, and the decision itself.

use std::sync::{Arc, Mutex, PoisonError};

use gleaner_dds::Dds;
use gleaner_messages::transport::{Clock, Delivery, Qos, SampleMeta, Sink, TopicSpec, Transport};
use gleaner_messages::{Definitions, FieldPath, MessageValue, Sources};

const TYPE: &str = "sensor_msgs/msg/TimeReference";

/// The answer to one sample.
#[derive(Clone)]
pub struct RttAnswer {
    /// Time of the decision, in ns of CLOCK_MONOTONIC.
    pub at_ns: i64,
    /// Time since the stamp of the sample, in ns.
    pub ns: f64,
    /// Time at which this process received it, in ns of CLOCK_MONOTONIC.
    pub arrived_ns: i64,
    /// Number of the wake, from 0; `None` if the answer has none.
    pub wake: Option<u64>,
    /// Labels of the triggers, with commas between them.
    pub labels: String,
}

impl RttAnswer {
    /// Stamp of the sample, in ns of CLOCK_MONOTONIC.
    pub fn stamp_ns(&self) -> i64 {
        self.at_ns - self.ns as i64
    }
}

/// Collects the answers on a topic.
pub struct RttReceiver {
    times: [FieldPath; 4],
    source: FieldPath,
    received: Mutex<Vec<RttAnswer>>,
}

impl RttReceiver {
    /// Subscribes to the answers on `topic`.
    ///
    /// # Panics
    ///
    /// If the subscription fails, which cannot happen in a private network.
    pub fn on(dds: &mut Dds, topic: &str) -> Arc<Self> {
        let definitions = definitions(TYPE);
        let path =
            |path: &str| FieldPath::compile(&definitions, path).expect("a field of the type");
        let times =
            ["header.stamp.sec", "header.stamp.nanosec", "time_ref.sec", "time_ref.nanosec"]
                .map(path);
        let answers = Arc::new(Self { times, source: path("source"), received: Mutex::default() });
        let spec = TopicSpec {
            topic: topic.to_owned(),
            type_name: TYPE.to_owned(),
            queue: 1024,
            max_bytes: 4096,
            // Not reliable: a lambda waits for a slow reliable reader, which would distort the
            // measurement.
            qos: Qos::Fixed { reliable: false, transient_local: false, depth: 1024 },
        };
        dds.subscribe(&spec, answers.clone()).expect("a private topic");
        answers
    }

    /// Takes all answers since the last call.
    pub fn take(&self) -> Vec<RttAnswer> {
        std::mem::take(&mut self.received.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Sink for RttReceiver {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let arrived_ns = Clock::new(0).now();
        let [a, b, c, d] =
            [0, 1, 2, 3].map(|n| self.times[n].number(cdr, meta.endian).unwrap_or(f64::NAN));
        // NAME:NUMBER:LABEL,LABEL
        let source = match self.source.read(cdr, meta.endian) {
            Ok(MessageValue::Text(text)) => text,
            _ => "",
        };
        let mut parts = source.splitn(3, ':').skip(1);
        let answer = RttAnswer {
            at_ns: (c * 1e9 + d) as i64,
            ns: (c - a) * 1e9 + (d - b),
            arrived_ns,
            wake: parts.next().and_then(|number| number.parse().ok()),
            labels: parts.next().unwrap_or_default().to_owned(),
        };
        self.received.lock().unwrap_or_else(PoisonError::into_inner).push(answer);
        Delivery::Taken
    }
}

/// The definitions of a type of common_interfaces.
pub fn definitions(type_name: &str) -> Definitions {
    let sources = Sources::new(&[], &[]);
    let text = sources.find(type_name).expect("bundled definitions are valid");
    let text = text.expect("a type of common_interfaces");
    Definitions::parse(type_name, &text).expect("bundled definitions are valid")
}
