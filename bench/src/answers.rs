//! Receives the answers that lambdas publish with `--rtt`: the time of each decision, and its delay
//! after the sample.

use std::sync::{Arc, Mutex, PoisonError};

use gleaner_dds::Dds;
use gleaner_messages::transport::{Delivery, Qos, SampleMeta, Sink, TopicSpec, Transport};
use gleaner_messages::{Definitions, FieldPath, Sources};

const TYPE: &str = "sensor_msgs/msg/TimeReference";

/// The answer to one sample.
#[derive(Clone, Copy)]
pub struct RttAnswer {
    /// Time of the decision, in ns of CLOCK_MONOTONIC.
    pub at_ns: i64,
    /// Time since the stamp of the sample, in ns.
    pub ns: f64,
}

/// Collects the answers on a topic.
pub struct RttReceiver {
    paths: [FieldPath; 4],
    received: Mutex<Vec<RttAnswer>>,
}

impl RttReceiver {
    /// Subscribes to the answers on `topic`.
    ///
    /// # Panics
    ///
    /// If the subscription fails, which cannot happen in a private network.
    pub fn on(dds: &mut Dds, topic: &str) -> Arc<Self> {
        let sources = Sources::new(&[], &[]);
        let text = sources
            .find(TYPE)
            .expect("bundled definitions are valid")
            .expect("a type of common_interfaces");
        let definitions = Definitions::parse(TYPE, &text).expect("bundled definitions are valid");
        let path =
            |path: &str| FieldPath::compile(&definitions, path).expect("a field of the type");
        let paths =
            ["header.stamp.sec", "header.stamp.nanosec", "time_ref.sec", "time_ref.nanosec"]
                .map(path);
        let answers = Arc::new(Self { paths, received: Mutex::default() });
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
        let [a, b, c, d] =
            [0, 1, 2, 3].map(|n| self.paths[n].number(cdr, meta.endian).unwrap_or(f64::NAN));
        let answer = RttAnswer { at_ns: (c * 1e9 + d) as i64, ns: (c - a) * 1e9 + (d - b) };
        self.received.lock().unwrap_or_else(PoisonError::into_inner).push(answer);
        Delivery::Taken
    }
}
