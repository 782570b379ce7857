//! A complete live run over a loopback and an ingress in this process: time, results, reports and
//! published decisions, without DDS, shim or sandbox.

use std::fs::File;
use std::io::{BufReader, PipeReader, Read, pipe};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_host::api::Session;
use gleaner_host::api::data::{Sample, Wake};
use gleaner_host::guest::{Guest, LambdaEngine, WakeOutcome};
use gleaner_host::live::{LiveRun, ResultsPipe, Settings};
use gleaner_host::session_setup::ConfiguredLambda;
use gleaner_ingress::Ingress;
use gleaner_lambda::manifest::Manifest;
use gleaner_lambda::{Fault, FaultKind};
use gleaner_messages::Definitions;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{
    Clock, Delivery, DiscoveredTopic, Guid, Health, LiveSource, PublishError, Publisher, Qos,
    SampleMeta, Sink, Subscription, TopicSpec, Transport, TransportError,
};
use gleaner_protocol::ingress::{
    AddReader, IngressControl, PublishGrant, ReceptionStatus, TopicGrant,
};
use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::{Handover, LiveStatus, Report, ResultItem};
use gleaner_samples::Feed;
use gleaner_tests::TempFolder;

use crate::recorded_run::{configured, until};

pub const PATIENCE: Duration = Duration::from_secs(60);
const NUMBERS: &str = "/numbers";
const DECISIONS: &str = "/decisions";

/// Numbers from this on: the lambda keeps the sample.
const KEEPS: i64 = 1000;

/// The lambda triggers with the number of the first sample that it keeps.
const RECALLS: i64 = 500;

/// Triggers with the number of each sample; a negative one is a fault.
struct NumbersGuest {
    session: Session,
    kept: Vec<Sample>,
}

impl Guest for NumbersGuest {
    fn init(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let Wake::Event(sample) = wake else { panic!("samples wake this lambda") };
        let value = sample.number(&sample.topic().field("value").unwrap()).unwrap();
        let kept = self.kept.first().filter(|_| value == RECALLS as f64);
        let number = |sample: &Sample| sample.number(&sample.topic().field("value").unwrap());
        let score = kept.map_or(value, |kept| number(kept).unwrap());
        self.session.event("number", score, Vec::new()).unwrap();
        if value >= KEEPS as f64 {
            self.kept.push(sample);
        }
        let fault = Fault {
            kind: FaultKind::Exception,
            message: "negative".to_owned(),
            used: None,
            allowed: None,
        };
        WakeOutcome {
            result: if value < 0.0 { Err(fault) } else { Ok(()) },
            fuel: None,
            run_ns: None,
            model_ns: None,
        }
    }

    fn discard(&mut self) {
        self.kept.clear();
    }

    fn engine(&self) -> LambdaEngine {
        LambdaEngine { name: "a test".to_owned(), models: Vec::new() }
    }
}

/// The hash that writers have announced.
pub type Announced = Arc<Mutex<Option<String>>>;

/// A loopback with a writer of each topic, which loses nothing itself.
pub struct WrittenLoopback(pub Loopback, pub Announced);

impl Transport for WrittenLoopback {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.0.topics()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        self.0.subscribe(spec, sink)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.0.definitions(topic)
    }

    fn status(&self, _: Subscription) -> ReceptionStatus {
        ReceptionStatus { writers: Some(1), lost: Some(0), ..ReceptionStatus::default() }
    }
}

impl LiveSource for WrittenLoopback {
    fn unsubscribe(&mut self, subscription: Subscription) {
        self.0.unsubscribe(subscription);
    }

    fn health(&self) -> Health {
        self.0.health()
    }

    fn layout(&self, _: Subscription) -> Option<String> {
        self.1.lock().unwrap().clone()
    }

    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        self.0.publisher(topic, type_name, depth)
    }
}

fn add_topics(loopback: &Loopback) {
    loopback.add_topic(NUMBERS, "test_msgs/msg/Number", "int64 value\n");
    loopback.add_topic(DECISIONS, "std_msgs/msg/String", "string data\n");
}

/// A run in a thread of its own.
pub struct Running {
    _folder: TempFolder,
    loopback: Loopback,
    pub announced: Announced,
    added: AddReader,
    /// The starter's end of the socket over which it passes connections.
    handover: UnixStream,
    /// `None` once the ingress has ended.
    ingress: Option<(IngressControl, JoinHandle<()>)>,
    clock: Clock,
    stop: Arc<AtomicBool>,
    reports: BufReader<PipeReader>,
    results: PipeReader,
    run: JoinHandle<Result<Exit, Failure>>,
    sent: u64,
}

impl Running {
    /// Starts a run and waits until it is ready.
    pub fn start(announce: Option<&str>) -> Self {
        let mut running = Self::begin(announce, None);
        running.until_ready();
        running
    }

    /// Waits until samples wake the lambda.
    pub fn until_ready(&mut self) {
        self.until(|report| matches!(report, Report::Ready).then_some(()));
    }

    /// Starts a run with this connection to a recorder, if any.
    pub fn begin(announce: Option<&str>, recorder: Option<OwnedFd>) -> Self {
        let manifest = "[lambda]\nname = \"numbers\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"numbers.wasm\"\n\
                        [schedule]\nevent = \"numbers\"\n\
                        [[input]]\nname = \"numbers\"\ntopic = \"/numbers\"\ntype = \"test_msgs/msg/Number\"\n";
        let lambda = TempFolder::new();
        lambda.write("build/lambda.toml", manifest);
        let manifest = Manifest::parse(manifest, "lambda.toml").unwrap();
        let (loopback, clock, stop) =
            (Loopback::new(), Clock::from_time_of_day(), Arc::<AtomicBool>::default());
        add_topics(&loopback);
        let (reports, to_reports) = pipe().unwrap();
        let (results, to_results) = pipe().unwrap();
        let announced = Announced::default();
        let source = Box::new(WrittenLoopback(loopback.clone(), announced.clone()));
        let (mut control, ingress) = Ingress::start_in_thread(source);
        let input = &manifest.inputs[0];
        let added = AddReader {
            name: "numbers".to_owned(),
            topics: vec![TopicGrant::for_input(0, input, NUMBERS, true, false)],
            publishes: PublishGrant::of_lambda(None, announce),
        };
        let socket = control.add_reader(&added).unwrap();
        let (handover, starter) = UnixStream::pair().unwrap();
        let (stopped, announce) = (Arc::clone(&stop), announce.map(str::to_owned));
        let folder = lambda.path().to_owned();
        let run = thread::spawn(move || {
            let heartbeat = Heartbeat::create().unwrap().0;
            let run = LiveRun {
                lambda: configured(&folder),
                manifest,
                settings: Settings {
                    out: folder,
                    all: false,
                    restarts: 0,
                    clock,
                    round_trip: None,
                    announce,
                },
                feed: Feed::connect(socket).unwrap(),
                starter: Some(starter.into()),
                recorder,
                results: ResultsPipe::over(
                    File::from(OwnedFd::from(to_results)),
                    heartbeat.clone(),
                ),
                heartbeat,
                close: &mut || Ok(Vec::new()),
                stop: &stopped,
            };
            let mut load = |_: &ConfiguredLambda, _: &Manifest, session: Session, _| {
                Ok(Box::new(NumbersGuest { session, kept: Vec::new() }) as Box<dyn Guest>)
            };
            run.run(&mut load, File::from(OwnedFd::from(to_reports)))
        });
        let (ingress, reports) = (Some((control, ingress)), BufReader::new(reports));
        Self {
            _folder: lambda,
            loopback,
            announced,
            added,
            handover,
            ingress,
            clock,
            stop,
            reports,
            results,
            run,
            sent: 0,
        }
    }

    /// Waits for the end of the run, which ends by itself.
    pub fn ended(self) -> Result<Exit, Failure> {
        self.run.join().unwrap()
    }

    /// Passes a connection to another recorder.
    pub fn pass_recorder(&self, socket: OwnedFd) {
        let recorder = Some(socket);
        Handover { recorder, ..Handover::default() }.try_send(&self.handover).unwrap();
    }

    pub fn end_ingress(&mut self) {
        let (control, ingress) = self.ingress.take().unwrap();
        drop(control);
        ingress.join().unwrap();
        // The next one subscribes them again.
        add_topics(&self.loopback);
    }

    /// Waits for the status of a run with so many ends of the ingress.
    pub fn interrupted(&mut self, count: u64) -> LiveStatus {
        self.live(|live| live.reception_gaps.count == count)
    }

    pub fn live(&mut self, is_it: impl Fn(&LiveStatus) -> bool) -> LiveStatus {
        self.until(|report| match report {
            Report::Live(live) if is_it(&live) => Some(*live),
            _ => None,
        })
    }

    /// Starts an ingress again; returns the run's connection to it.
    pub fn start_ingress(&mut self) -> OwnedFd {
        let source = Box::new(WrittenLoopback(self.loopback.clone(), self.announced.clone()));
        let (mut control, ingress) = Ingress::start_in_thread(source);
        let socket = control.add_reader(&self.added).unwrap();
        self.ingress = Some((control, ingress));
        socket
    }

    pub fn hand_over(&self, socket: OwnedFd) {
        let ingress = Some(socket);
        Handover { ingress, ..Handover::default() }.try_send(&self.handover).unwrap();
    }

    pub fn publish(&mut self, value: i64) {
        self.publish_in(0, value);
    }

    /// Publishes a number by a writer that announces a hash, if `layout` is 1.
    pub fn publish_in(&mut self, layout: u16, value: i64) {
        self.sent += 1;
        let (at_ns, seq) = (self.clock.now(), self.sent);
        let meta = SampleMeta { writer: Guid([7; 16]), layout, ..crate::meta(at_ns, seq) };
        self.loopback.publish(NUMBERS, &meta, &value.to_le_bytes()).unwrap();
    }

    fn until<T>(&mut self, looked_for: impl FnMut(Report) -> Option<T>) -> T {
        until(&mut self.reports, looked_for)
    }

    /// Waits for the decision of the next wake with a trigger, and returns its score.
    pub fn decided(&mut self) -> f64 {
        self.until(|report| {
            if let Report::Decision(decision) = report { decision.triggers[0].score } else { None }
        })
    }

    /// Stops the run; returns its end, and its results.
    pub fn stop(mut self) -> (Result<Exit, Failure>, Vec<ResultItem>) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.run.join().unwrap();
        let mut text = String::new();
        self.results.read_to_string(&mut text).unwrap();
        (ended, text.lines().map(|line| serde_json::from_str(line).unwrap()).collect())
    }
}

#[test]
fn each_sample_wakes_the_lambda_and_each_decision_is_a_report_and_a_result() {
    let mut running = Running::start(None);
    for value in [3, 1, 2] {
        running.publish(value);
        assert_eq!(running.decided(), value as f64);
    }
    let (ended, pages) = running.stop();
    assert_eq!(ended.unwrap(), Exit::Ok);
    let [
        ResultItem::Woken(woken_by),
        ResultItem::Decision(_),
        ResultItem::Decision(_),
        ResultItem::Decision(_),
        ResultItem::Last(last),
    ] = &pages[..]
    else {
        panic!("{pages:?}");
    };
    assert_eq!(woken_by.topic.as_deref(), Some(NUMBERS));
    assert_eq!((last.wakes, last.triggers, last.faults, last.topics[0].received), (3, 3, 0, 3));
    assert_eq!(last.network, gleaner_protocol::NetworkStatus::default(), "a loopback has none");
}

#[test]
fn after_a_fault_the_run_goes_on_and_its_exit_code_reports_it() {
    let mut running = Running::start(None);
    running.publish(-1);
    assert_eq!(running.decided(), -1.0, "triggers before the fault count");
    running.publish(5);
    assert_eq!(running.decided(), 5.0);
    let (ended, pages) = running.stop();
    assert_eq!(ended.unwrap(), Exit::LambdaFaulted);
    let faults = pages
        .iter()
        .filter(|page| matches!(page, ResultItem::Decision(decision) if decision.fault.is_some()));
    assert_eq!(faults.count(), 1);
}

#[test]
fn a_run_outlives_its_ingress_and_attaches_to_the_next_one() {
    let mut running = Running::start(Some(DECISIONS));
    running.publish(KEEPS);
    assert_eq!(running.decided(), KEEPS as f64);
    running.live(|live| live.topics[0].lost == Some(0));
    running.end_ingress();
    let gone = running.interrupted(1);
    assert_eq!((gone.topics[0].received, gone.topics[0].lost), (1, None), "unknown is never 0");
    (0..3).for_each(|value| running.publish(value));
    // One that ends before it has received a sample, and another one.
    let ended = running.start_ingress();
    running.end_ingress();
    running.hand_over(ended);
    let socket = running.start_ingress();
    running.hand_over(socket);
    running.live(|live| live.topics[0].writers == Some(1));
    let decisions = subscribe(&running.loopback, DECISIONS);
    running.publish(RECALLS);
    assert_eq!(running.decided(), KEEPS as f64, "the sample in the earlier memory is unchanged");
    decisions.recv_timeout(PATIENCE).expect("the decision is published through the next ingress");
    let live = running.live(|live| live.topics[0].lost.is_some());
    assert_eq!((live.topics[0].received, live.topics[0].lost), (2, Some(3)));
    assert!(live.reception_gaps.ms > 0, "{live:?}");
    // Again, without a loss.
    running.end_ingress();
    running.interrupted(3);
    let socket = running.start_ingress();
    running.hand_over(socket);
    running.live(|live| live.topics[0].writers == Some(1));
    running.publish(RECALLS);
    assert_eq!(running.decided(), KEEPS as f64);
    running.live(|live| live.topics[0].lost == Some(3));
    let (ended, pages) = running.stop();
    assert_eq!(ended.unwrap(), Exit::Ok);
    let Some(ResultItem::Last(last)) = pages.last() else { panic!("{pages:?}") };
    assert_eq!((last.wakes, last.unsent, last.reception_gaps.count), (3, 0, 3));
}

#[test]
fn a_run_ends_with_its_ingress_if_its_starter_has_ended() {
    let mut running = Running::start(None);
    running.publish(4);
    assert_eq!(running.decided(), 4.0);
    running.handover.shutdown(std::net::Shutdown::Both).unwrap();
    running.end_ingress();
    running.until(|report| matches!(report, Report::Ended(_)).then_some(()));
    let (ended, pages) = running.stop();
    let failure = ended.unwrap_err();
    assert_eq!((failure.exit, &*failure.message), (Exit::Unreachable, "the ingress has ended"));
    assert!(matches!(pages.last(), Some(ResultItem::Last(last)) if last.wakes == 1), "{pages:?}");
}

#[test]
fn a_lambda_that_keeps_too_many_samples_faults_and_goes_on() {
    let mut running = Running::start(None);
    // Its manifest has `hold` = 8; some more are for the host. The sample that it cannot hold wakes
    // nothing, and the next wake ends in the fault.
    let mut value = KEEPS;
    let fault = loop {
        assert!(value < KEEPS + 1000, "it may keep any number of samples");
        running.publish(value);
        value += 1;
        let fault = running.until(|report| match report {
            Report::Decision(decision) => Some(decision.fault),
            Report::Live(_) => Some(None),
            _ => None,
        });
        if let Some(fault) = fault {
            break fault;
        }
    };
    assert_eq!(fault.kind, FaultKind::HostCall);
    assert!(fault.message.contains("input `numbers`: raise `hold` of this [[input]]"), "{fault:?}");
    running.publish(5);
    // Decisions on the samples before it may be on the way.
    while running.decided() != 5.0 {}
    let (ended, _) = running.stop();
    assert_eq!(ended.unwrap(), Exit::LambdaFaulted);
}

struct ForwardingSink(Mutex<SyncSender<Vec<u8>>>);

impl Sink for ForwardingSink {
    fn deliver(&self, _: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.0.lock().unwrap().send(cdr.to_vec()).unwrap();
        Delivery::Taken
    }
}

fn subscribe(loopback: &Loopback, topic: &str) -> Receiver<Vec<u8>> {
    let (sender, receiver) = sync_channel(64);
    let spec = TopicSpec {
        topic: topic.to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        queue: 8,
        max_bytes: 1 << 20,
        qos: Qos::Auto,
    };
    loopback.clone().subscribe(&spec, Arc::new(ForwardingSink(Mutex::new(sender)))).unwrap();
    receiver
}

#[test]
fn decisions_are_published_on_the_requested_topic() {
    let mut running = Running::start(Some(DECISIONS));
    let decisions = subscribe(&running.loopback, DECISIONS);
    running.publish(6);
    let message = decisions.recv_timeout(PATIENCE).unwrap();
    // A string in CDR: its length with the zero at its end, and that zero.
    let text = std::str::from_utf8(&message[4..message.len() - 1]).unwrap();
    let announced: serde_json::Value = serde_json::from_str(text).unwrap();
    assert_eq!(announced["lambda"], "numbers");
    assert_eq!(announced["decision"]["triggers"][0]["score"], 6.0);
    let (ended, _) = running.stop();
    assert_eq!(ended.unwrap(), Exit::Ok);
}
