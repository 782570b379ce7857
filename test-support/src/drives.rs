//! For tests of drives and of sources: messages, sinks, the example drive.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use gleaner_messages::transport::{Delivery, SampleMeta, Sink, TopicSpec};

pub const TYPE: &str = "test_msgs/msg/Number";
pub const TEXT: &str = "int64 value\n";

pub fn sample_drive() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/data/highway_drive.mcap")
}

#[derive(Default)]
pub struct MemorySink(pub Mutex<Vec<(SampleMeta, Vec<u8>)>>);

impl Sink for MemorySink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.0.lock().unwrap().push((*meta, cdr.to_vec()));
        Delivery::Taken
    }
}

impl MemorySink {
    /// Returns (log time, value) of each message, for messages of [`TEXT`].
    pub fn values(&self) -> Vec<(i64, i64)> {
        let taken = self.0.lock().unwrap();
        let value = |cdr: &[u8]| i64::from_le_bytes(cdr.try_into().unwrap());
        taken.iter().map(|(meta, cdr)| (meta.at_ns, value(cdr))).collect()
    }
}

/// A sink that takes all samples, and keeps none.
pub struct DiscardSink;

impl Sink for DiscardSink {
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Delivery {
        Delivery::Taken
    }
}

pub fn spec(topic: &str) -> TopicSpec {
    let (topic, type_name) = (topic.to_owned(), TYPE.to_owned());
    TopicSpec { topic, type_name, queue: 1, max_bytes: 1 << 20, qos: Default::default() }
}
