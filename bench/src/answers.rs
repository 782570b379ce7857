//! What lambdas answer with `--rtt`: when each decision was out, and how long after the sample it
//! was.

use std::sync::{Arc, Mutex, PoisonError};

use gleaner_dds::Dds;
use gleaner_messages::{Definitions, FieldPath, Sources};
use gleaner_transport::{Qos, SampleMeta, Sink, TopicSpec, Transport, Verdict};

const TYPE: &str = "sensor_msgs/msg/TimeReference";

/// One decision.
#[derive(Clone, Copy)]
pub struct Answer {
    /// When it was out, in ns of CLOCK_MONOTONIC.
    pub at_ns: i64,
    /// How long after the stamp of its sample, in ns.
    pub ns: f64,
}

/// Collects the answers on one topic.
pub struct Answers {
    paths: [FieldPath; 4],
    heard: Mutex<Vec<Answer>>,
}

impl Answers {
    /// Those on `topic`, from now on.
    ///
    /// # Panics
    ///
    /// If the topic cannot be subscribed to: in a private network nothing keeps us from it.
    pub fn on(dds: &mut Dds, topic: &str) -> Arc<Self> {
        let sources = Sources::new(&[], &[]);
        let text = sources
            .find(TYPE)
            .expect("bundled definitions are sound")
            .expect("a type of common_interfaces");
        let definitions = Definitions::parse(TYPE, &text).expect("bundled definitions are sound");
        let path =
            |path: &str| FieldPath::compile(&definitions, path).expect("a field of the type");
        let paths =
            ["header.stamp.sec", "header.stamp.nanosec", "time_ref.sec", "time_ref.nanosec"]
                .map(path);
        let answers = Arc::new(Self { paths, heard: Mutex::default() });
        let spec = TopicSpec {
            topic: topic.to_owned(),
            type_name: TYPE.to_owned(),
            queue: 1024,
            max_bytes: 4096,
            // Not reliable: a lambda waits for a reliable reader that does not keep up, and then it
            // is us that we measure.
            qos: Qos::Fixed { reliable: false, transient_local: false, depth: 1024 },
        };
        dds.subscribe(&spec, answers.clone()).expect("a topic of ours");
        answers
    }

    /// All since the last call.
    pub fn take(&self) -> Vec<Answer> {
        std::mem::take(&mut self.heard.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Sink for Answers {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        let [a, b, c, d] =
            [0, 1, 2, 3].map(|n| self.paths[n].number(cdr, meta.endian).unwrap_or(f64::NAN));
        let answer = Answer { at_ns: (c * 1e9 + d) as i64, ns: (c - a) * 1e9 + (d - b) };
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).push(answer);
        Verdict::Taken
    }
}
