//! Runs the recorder process within a test: a network that the test feeds, an ingress over it,
//! lambdas, and reports.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, PipeReader};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::program::{RecorderConnections, RecorderOptions, run};
use gleaner_base::{Failure, hex};
use gleaner_ingress::Ingress;
use gleaner_journal::{FileDigest, JournalHeader};
use gleaner_lambda::manifest::Limits;
use gleaner_lambda::{Clip, TriggerKind};
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{
    Clock, Delivery, DiscoveredTopic, Health, LiveSource, PublishError, Publisher, Sink,
    Subscription, TopicSpec, Transport, TransportError,
};
use gleaner_messages::{Definitions, Sources};
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::{
    AddReader, AddTopics, IngressControl, Qos, ReceptionStatus, commands_grant, recorded_grant,
};
use gleaner_protocol::link::{
    AddLambda, ControlClient, LinkError, RecorderLink, RecorderReport, RecorderStatus,
};
use sha2::{Digest, Sha256};

use crate::recorder::tests::support::{TestDir, entry, member, meta};

pub const TIMEOUT: Duration = Duration::from_secs(60);

/// A loopback that the test feeds while the process listens.
#[derive(Clone, Default)]
pub struct FakeNetwork {
    pub loopback: Loopback,
    pub specs: Arc<Mutex<Vec<TopicSpec>>>,
    /// The hash of the layout that writers announce.
    pub announced: Arc<Mutex<Option<String>>>,
    /// Other types of a topic, by other writers.
    others: Arc<Mutex<Vec<DiscoveredTopic>>>,
}

impl FakeNetwork {
    pub fn add(&self, topic: &str) {
        self.loopback.add_topic(topic, "test_msgs/msg/Number", "int64 value\n");
    }

    /// Adds another writer of the topic with another type, listed first.
    pub fn add_other(&self, topic: &str, type_name: &str) {
        let (topic, type_name) = (topic.to_owned(), type_name.to_owned());
        let definitions_text = Some("string other\n".into());
        let other =
            DiscoveredTopic { topic, type_name, definitions_text, ..DiscoveredTopic::default() };
        self.others.lock().unwrap().push(other);
    }

    pub fn add_texts(&self, topic: &str) {
        self.loopback.add_topic(topic, "std_msgs/msg/String", "string data\n");
    }

    /// Publishes a text; returns the delivery, or `None` without a subscription.
    pub fn publish_text(&self, topic: &str, at_ns: i64, text: &[u8]) -> Option<Delivery> {
        self.loopback.publish(topic, &meta(at_ns, 1), &cdr(text)).unwrap()
    }

    pub fn publish(&self, topic: &str, at_ns: i64, seq: u64, cdr: &[u8]) {
        self.loopback.publish(topic, &meta(at_ns, seq), cdr).unwrap();
    }
}

impl Transport for FakeNetwork {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        let mut topics = self.others.lock().unwrap().clone();
        topics.extend(self.loopback.topics());
        topics
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        self.specs.lock().unwrap().push(spec.clone());
        self.loopback.subscribe(spec, sink)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.loopback.definitions(topic)
    }

    fn status(&self, _: Subscription) -> ReceptionStatus {
        ReceptionStatus { writers: Some(1), lost: Some(0), ..ReceptionStatus::default() }
    }
}

impl LiveSource for FakeNetwork {
    fn unsubscribe(&mut self, _: Subscription) {}

    fn layout(&self, _: Subscription) -> Option<String> {
        self.announced.lock().unwrap().clone()
    }

    fn health(&self) -> Health {
        self.loopback.health()
    }

    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        self.loopback.publisher(topic, type_name, depth)
    }
}

const NAME: &str = "recorder";

/// The starter of a recorder, and of the ingress that it reads.
pub struct FakeStarter {
    pub control: ControlClient,
    /// `None` once the ingress has ended.
    pub ingress: Option<(IngressControl, JoinHandle<()>)>,
    /// To pass the connection to a later ingress.
    handover: UnixStream,
    /// The recorder as a reader, with all topics that were granted so far.
    reader: AddReader,
    /// Topics that were granted, by their ids from 1 on.
    granted: Vec<String>,
}

impl FakeStarter {
    pub fn start(
        network: &FakeNetwork,
        options: RecorderOptions,
        reports: File,
        stop: Arc<AtomicBool>,
    ) -> (FakeStarter, JoinHandle<Result<(), Failure>>) {
        let (control, stdin) = ControlClient::pair().unwrap();
        let (mut ingress, ingress_thread) = Ingress::start_in_thread(Box::new(network.clone()));
        let reader = AddReader {
            name: NAME.to_owned(),
            topics: options.commands.iter().map(|topic| commands_grant(topic)).collect(),
            publishes: Vec::new(),
        };
        let socket = ingress.add_reader(&reader).unwrap();
        let (handover, starter) = UnixStream::pair().unwrap();
        let connections = RecorderConnections {
            control: stdin,
            ingress: socket,
            starter: Some(starter.into()),
            signer: None,
        };
        let thread = thread::spawn(move || run(options, connections, reports, stop));
        let ingress = Some((ingress, ingress_thread));
        (FakeStarter { control, ingress, handover, reader, granted: Vec::new() }, thread)
    }

    /// Ends the ingress. Topics of the network have no subscription then.
    pub fn end_ingress(&mut self, network: &FakeNetwork) {
        // Before its end: nothing writes to the memory of an ingress that has ended.
        self.granted.iter().for_each(|topic| network.add(topic));
        let (control, thread) = self.ingress.take().unwrap();
        drop(control);
        thread.join().unwrap();
    }

    /// Ends the connection over which the recorder would receive another one to an ingress.
    pub fn end_handover(&self) {
        self.handover.shutdown(std::net::Shutdown::Both).unwrap();
    }

    /// Starts an ingress again, and passes the recorder its connection.
    pub fn start_ingress(&mut self, network: &FakeNetwork) {
        let (mut ingress, thread) = Ingress::start_in_thread(Box::new(network.clone()));
        let socket = Some(ingress.add_reader(&self.reader).unwrap());
        Handover { ingress: socket, ..Handover::default() }.try_send(&self.handover).unwrap();
        self.ingress = Some((ingress, thread));
    }

    /// Adds a lambda, and grants the topics of [`lambda`] to the recorder.
    pub fn add(&mut self, add: &AddLambda) -> Result<OwnedFd, LinkError> {
        let mut add = add.clone();
        for (topic, type_name) in [("/a", Some("test_msgs/msg/Number".to_owned())), ("/b", None)] {
            let known = self.granted.iter().position(|granted| granted == topic);
            let index = known.unwrap_or_else(|| {
                self.granted.push(topic.to_owned());
                let id = self.granted.len() as u32;
                let topics = vec![recorded_grant(id, topic, type_name, Some(64 << 10), Qos::Auto)];
                self.reader.topics.extend(topics.clone());
                let (ingress, _) = self.ingress.as_mut().unwrap();
                ingress.add_topics(&AddTopics { reader: NAME.to_owned(), topics }).unwrap();
                self.granted.len() - 1
            });
            add.grants.push((topic.to_owned(), index as u32 + 1));
        }
        self.control.add(&add)
    }
}

pub struct Running {
    pub starter: FakeStarter,
    reports: BufReader<PipeReader>,
    thread: JoinHandle<Result<(), Failure>>,
    pub stop: Arc<AtomicBool>,
    pub clock: Clock,
}

pub fn options(out: &Path, clock: Clock) -> RecorderOptions {
    RecorderOptions {
        out: out.to_owned(),
        clock,
        messages: Sources::default(),
        preroll_bytes: None,
        disk_floor: 0,
        clips_max: None,
        bytes_max: None,
        commands: None,
    }
}

impl Running {
    pub fn start(
        scratch: &TestDir,
        network: &FakeNetwork,
        change: impl FnOnce(&mut RecorderOptions),
    ) -> Running {
        let clock = Clock::from_time_of_day();
        let mut options = options(&scratch.0, clock);
        change(&mut options);
        let (reader, writer) = std::io::pipe().unwrap();
        let stop = Arc::<AtomicBool>::default();
        let reports = File::from(OwnedFd::from(writer));
        let (starter, thread) = FakeStarter::start(network, options, reports, Arc::clone(&stop));
        let reports = BufReader::new(reader);
        let mut running = Running { starter, reports, thread, stop, clock };
        running.until(|report| matches!(report, RecorderReport::Ready).then_some(()));
        running
    }

    pub fn start_with_a(scratch: &TestDir) -> (Running, FakeNetwork) {
        let network = FakeNetwork::default();
        network.add("/a");
        (Running::start(scratch, &network, |_| {}), network)
    }

    /// Adds [`lambda`], and connects as its process does.
    pub fn join(&mut self, scratch: &TestDir, name: &str, rolls_ms: (u32, u32)) -> RecorderLink {
        let (folder, header) = lambda(scratch, name, rolls_ms);
        let mut link = RecorderLink::new(self.add(&add(&folder)).unwrap());
        link.hello(&header, TIMEOUT).unwrap();
        link
    }

    pub fn event(&self, link: &mut RecorderLink) {
        link.wake(&entry(self.clock.now(), &[TriggerKind::Event]), monotonic(self.clock)).unwrap();
    }

    pub fn stopped(mut self) -> (RecorderStatus, Result<(), Failure>) {
        self.starter.control.stop().unwrap();
        self.ended()
    }

    pub fn add(&mut self, add: &AddLambda) -> Result<OwnedFd, LinkError> {
        self.starter.add(add)
    }

    pub fn until<T>(&mut self, mut matches: impl FnMut(RecorderReport) -> Option<T>) -> T {
        loop {
            let mut line = String::new();
            assert!(self.reports.read_line(&mut line).unwrap() > 0, "the reports end");
            if let Some(found) = matches(serde_json::from_str(&line).unwrap()) {
                return found;
            }
        }
    }

    pub fn clip(&mut self) -> Clip {
        self.until(
            |report| if let RecorderReport::Clip(clip) = report { Some(*clip) } else { None },
        )
    }

    pub fn status(&mut self, wanted: impl Fn(&RecorderStatus) -> bool) -> RecorderStatus {
        self.until(|report| match report {
            RecorderReport::Status(status) if wanted(&status) => Some(*status),
            _ => None,
        })
    }

    pub fn ended(mut self) -> (RecorderStatus, Result<(), Failure>) {
        let last =
            self.until(
                |report| if let RecorderReport::Ended(last) = report { Some(*last) } else { None },
            );
        (last, self.thread.join().unwrap())
    }
}

/// A built lambda that records `/a`, and the header of its journal.
pub fn lambda(scratch: &TestDir, name: &str, rolls_ms: (u32, u32)) -> (PathBuf, JournalHeader) {
    let text = format!(
        "[lambda]\nname = \"{name}\"\nversion = \"1.2.3\"\nkind = \"python\"\n\
         entry = \"main.py\"\n[schedule]\nevent = \"numbers\"\n\
         [[input]]\nname = \"numbers\"\ntopic = \"/a\"\ntype = \"test_msgs/msg/Number\"\n\
         [record]\ntopics = [\"/a\", \"/b\"]\npreroll = \"{}ms\"\n\
         postroll = \"{}ms\"\npreroll_size = \"2 MiB\"\n",
        rolls_ms.0, rolls_ms.1
    );
    let folder = scratch.0.join(name);
    fs::create_dir_all(folder.join("build")).unwrap();
    fs::write(folder.join("build/lambda.toml"), &text).unwrap();
    let header = with_manifest(member(name, (0, 0, 0), &[]).header, &text);
    (folder, header)
}

pub fn with_manifest(header: JournalHeader, text: &str) -> JournalHeader {
    let sha256 = hex(&Sha256::digest(text));
    let manifest = FileDigest { path: "lambda.toml".to_owned(), bytes: text.len() as u64, sha256 };
    JournalHeader { files: vec![manifest], ..header }
}

/// A `std_msgs/msg/String`.
pub fn cdr(text: &[u8]) -> Vec<u8> {
    [&(text.len() as u32 + 1).to_le_bytes()[..], text, &[0]].concat()
}

pub fn add(folder: &Path) -> AddLambda {
    AddLambda {
        lambda: folder.to_owned(),
        remaps: Vec::new(),
        most: Limits::MAX,
        grants: Vec::new(),
    }
}

pub fn monotonic(clock: Clock) -> i64 {
    clock.monotonic(clock.now())
}

/// A number each ms on `/a`, as long as it lives.
pub struct Sensor {
    stop: Arc<AtomicBool>,
    /// Number and stamp of each sample so far.
    published: Arc<Mutex<Vec<(u64, i64)>>>,
    thread: Option<JoinHandle<u64>>,
}

impl Sensor {
    pub fn start(network: &FakeNetwork, clock: Clock) -> Sensor {
        let (stop, network) = (Arc::<AtomicBool>::default(), network.clone());
        let stopped = Arc::clone(&stop);
        let published = Arc::<Mutex<Vec<_>>>::default();
        let noted = Arc::clone(&published);
        let thread = thread::spawn(move || {
            let mut seq = 0_u64;
            while !stopped.load(Ordering::Relaxed) {
                seq += 1;
                let at_ns = clock.now();
                noted.lock().unwrap().push((seq, at_ns));
                network.publish("/a", at_ns, seq, &seq.to_le_bytes());
                thread::sleep(Duration::from_millis(1));
            }
            seq
        });
        Sensor { stop, published, thread: Some(thread) }
    }

    /// The numbers of the samples of that time, both ends included.
    pub fn numbers(&self, from_ns: i64, to_ns: i64) -> Vec<u32> {
        let published = self.published.lock().unwrap();
        published
            .iter()
            .filter(|(_, at_ns)| (from_ns..=to_ns).contains(at_ns))
            .map(|(seq, _)| *seq as u32)
            .collect()
    }
}

impl Drop for Sensor {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

pub fn received(running: &mut Running, least: u64) {
    running.status(|status| {
        status.topics.iter().any(|topic| topic.topic == "/a" && topic.received >= least)
    });
}

pub fn follow_each_other(numbers: &[u32]) -> bool {
    numbers.windows(2).all(|pair| pair[1] == pair[0] + 1)
}
