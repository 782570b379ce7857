//! An ingress, its source and its readers.

use std::collections::VecDeque;
use std::os::fd::OwnedFd;
use std::sync::mpsc::{Receiver, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use gleaner_ingress::Ingress;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Delivery, Guid, LiveSource, SampleMeta, StoredMeta};
use gleaner_protocol::ingress::{
    AddReader, IngressControl, IngressReport, IngressStatus, PinGrant, PublishGrant, TopicGrant,
};
use gleaner_samples::{Feed, SharedTopicReader};

/// Time after which an awaited event is missing.
pub const TIMEOUT: Duration = Duration::from_secs(60);

pub const TYPE: &str = "test_msgs/msg/Number";
pub const TEXT: &str = "int64 value\n";

/// An ingress in a thread, which ends when this value is dropped.
pub struct RunningIngress {
    pub control: Option<IngressControl>,
    thread: Option<JoinHandle<()>>,
    reports: Receiver<IngressReport>,
}

impl RunningIngress {
    pub fn over(source: impl LiveSource + 'static) -> Self {
        let (sender, reports) = channel();
        let report = move |report| drop(sender.send(report));
        let (control, thread) =
            Ingress::start_with_reports(Box::new(source), report).expect("a thread");
        Self { control: Some(control), thread: Some(thread), reports }
    }

    /// Starts an ingress of a loopback with one topic.
    pub fn of_numbers(topic: &'static str) -> (Numbers, Self) {
        let numbers = Numbers::on(topic);
        let ingress = Self::over(numbers.source.clone());
        (numbers, ingress)
    }

    pub fn control(&mut self) -> &mut IngressControl {
        self.control.as_mut().expect("it runs")
    }

    /// Adds a reader; returns its socket.
    pub fn socket(&mut self, name: &str, topics: Vec<TopicGrant>) -> OwnedFd {
        let add = AddReader { name: name.to_owned(), topics, publishes: Vec::new() };
        self.control().add_reader(&add).unwrap()
    }

    /// Adds a reader and connects it.
    pub fn reader(&mut self, name: &str, topics: Vec<TopicGrant>) -> Feed {
        Feed::connect(self.socket(name, topics)).unwrap()
    }

    /// Adds a reader of one topic.
    pub fn reading(&mut self, name: &str, grant: TopicGrant) -> Reading {
        let id = grant.id;
        let mut feed = self.reader(name, vec![grant]);
        let topic = feed.topic(id, TIMEOUT).unwrap();
        Reading { next: topic.info.first, topic, feed }
    }

    pub fn publisher(&mut self, name: &str, publishes: Vec<PublishGrant>) -> Feed {
        let add = AddReader { name: name.to_owned(), topics: Vec::new(), publishes };
        Feed::connect(self.control().add_reader(&add).unwrap()).unwrap()
    }

    pub fn report<T>(&self, mut find: impl FnMut(IngressReport) -> Option<T>) -> T {
        let until = Instant::now() + TIMEOUT;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let report = self.reports.recv_timeout(left).expect("a report");
            if let Some(found) = find(report) {
                return found;
            }
        }
    }

    /// Waits for a status that is as expected.
    pub fn status(&self, is_it: impl Fn(&IngressStatus) -> bool) -> IngressStatus {
        self.report(|report| match report {
            IngressReport::Status(status) if is_it(&status) => Some(*status),
            _ => None,
        })
    }

    /// Waits for the end of the ingress; returns its last status.
    pub fn end(mut self) -> IngressStatus {
        self.control = None;
        let thread = self.thread.take().expect("it runs");
        thread.join().unwrap();
        self.report(|report| match report {
            IngressReport::Ended(status) => Some(*status),
            _ => None,
        })
    }
}

impl Drop for RunningIngress {
    fn drop(&mut self) {
        self.control = None;
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

/// A reader of one topic, at a position.
pub struct Reading {
    pub feed: Feed,
    pub topic: SharedTopicReader,
    pub next: u64,
}

impl Reading {
    /// Returns sequence number and bytes of each sample that was not read yet.
    pub fn new_samples(&mut self) -> Vec<(u64, Vec<u8>)> {
        let mut samples = Vec::new();
        while let Some(sample) = self.topic.reader.get(self.next).unwrap() {
            let stored = StoredMeta::of_words(sample.meta());
            samples.push((stored.sample.seq, sample.to_vec()));
            self.next += 1;
        }
        samples
    }

    /// Returns the sequence numbers of the samples that were not read yet.
    pub fn new_numbers(&mut self) -> Vec<u64> {
        self.new_samples().into_iter().map(|(seq, _)| seq).collect()
    }
}

/// Publishes numbered samples on a loopback.
#[derive(Clone)]
pub struct Numbers {
    pub source: Loopback,
    pub topic: &'static str,
    pub seq: u64,
}

impl Numbers {
    pub fn on(topic: &'static str) -> Self {
        let source = Loopback::new();
        source.add_topic(topic, TYPE, TEXT);
        Self { source, topic, seq: 0 }
    }

    /// Publishes a sample of `len` bytes, each of which is the lower byte of its number.
    pub fn publish(&mut self, len: usize) -> Option<Delivery> {
        self.seq += 1;
        let cdr = vec![self.seq as u8; len];
        self.source.publish(self.topic, &meta(self.seq), &cdr).unwrap()
    }

    /// Publishes samples of 8 bytes; returns their numbers.
    pub fn publish_all(&mut self, count: u64) -> Vec<u64> {
        let first = self.seq + 1;
        for _ in 0..count {
            self.publish(8);
        }
        (first..=self.seq).collect()
    }
}

pub fn meta(seq: u64) -> SampleMeta {
    SampleMeta {
        publish_ns: seq as i64,
        ..SampleMeta::new(seq as i64 * 10, Guid(*b"number publisher"), seq)
    }
}

/// A grant of small samples.
pub fn grant(id: u32, topic: &str) -> TopicGrant {
    TopicGrant {
        id,
        topic: topic.to_owned(),
        type_name: Some(TYPE.to_owned()),
        queue: 8,
        max_bytes: Some(64),
        depth: 64,
        holds: PinGrant { windows: 1, window: 8, singles: 4 },
        wakes: true,
        ..TopicGrant::default()
    }
}

pub fn wait_for<T>(mut find: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + TIMEOUT;
    loop {
        if let Some(found) = find() {
            return found;
        }
        assert!(Instant::now() < until, "it did not happen in time");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Collects what `more` returns until there are `count`.
pub fn collect<T>(count: usize, mut more: impl FnMut() -> Vec<T>) -> Vec<T> {
    let mut all = VecDeque::new();
    wait_for(|| {
        all.extend(more());
        (all.len() >= count).then_some(())
    });
    all.into()
}
