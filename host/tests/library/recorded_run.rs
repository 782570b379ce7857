//! A live run and its recorder in threads, over one ingress.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, PipeReader, pipe};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_host::api::Session;
use gleaner_host::api::data::Wake;
use gleaner_host::api::models::Models;
use gleaner_host::guest::{Guest, LambdaEngine, WakeOutcome};
use gleaner_host::live::{LiveRun, ResultsPipe, Settings};
use gleaner_host::replay::{ReplayJob, VerifyArgs};
use gleaner_host::session_setup::{ConfiguredLambda, RunMode};
use gleaner_ingress::Ingress;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_lambda::{BuildDir, Clip, Fault, FaultKind};
use gleaner_messages::Sources;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Clock, Guid, SampleMeta};
use gleaner_protocol::ingress::{
    AddReader, AddTopics, IngressControl, IngressReport, IngressStatus, IngressTopic, Qos,
    TopicGrant, recorded_grant,
};
use gleaner_protocol::link::{AddLambda, ControlClient, RecordedTopic, RecorderReport};
use gleaner_protocol::process_stats::Heartbeat;
use gleaner_protocol::{Handover, Report, Verified};
use gleaner_recorder::program::{RecorderConnections, RecorderOptions, run as record};
use gleaner_samples::Feed;
use tempfile::TempDir;

const MANIFEST: &str = "[lambda]\nname = \"adder\"\nversion = \"0.1.0\"\nkind = \"wasm\"\n\
                        entry = \"adder.wasm\"\n[schedule]\nevent = \"numbers\"\n\
                        [[input]]\nname = \"numbers\"\ntopic = \"/numbers\"\n\
                        type = \"test_msgs/msg/Number\"\ndepth = 8\n\
                        [[input]]\nname = \"others\"\ntopic = \"/others\"\n\
                        type = \"test_msgs/msg/Number\"\ndepth = 4\nmax_size = \"64 B\"\n\
                        [record]\ntopics = [\"/numbers\", \"/others\"]\npreroll = \"4s\"\n\
                        postroll = \"50ms\"\n";
/// The recorded topics, with the ids of their grants.
const TOPICS: [(&str, u32); 2] = [("/numbers", 1), ("/others", 2)];
/// Value at which the lambda triggers.
pub const TRIGGER: i64 = 1000;
/// Value at which the lambda exceeds its deadline, if it has one.
pub const SLOW: i64 = -1;

/// Sums up what it sees, and what it has seen since its start.
struct AddingGuest {
    session: Session,
    mode: RunMode,
    sum: Option<f64>,
    wakes: Arc<AtomicU64>,
}

impl Guest for AddingGuest {
    fn init(&mut self) -> Result<(), Fault> {
        self.sum = Some(0.0);
        Ok(())
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let Wake::Event(sample) = wake else { panic!("samples wake this lambda") };
        self.wakes.fetch_add(1, Ordering::Relaxed);
        let mut sum = self.sum.take().unwrap_or(0.0);
        let inputs = self.session.inputs();
        for topic in inputs.iter() {
            let field = topic.field("value").unwrap();
            sum += topic.column(&field, 5).unwrap().values.iter().sum::<f64>();
        }
        let value = sample.number(&sample.topic().field("value").unwrap()).unwrap() as i64;
        if value >= TRIGGER {
            self.session.event("sum", sum, Vec::new()).unwrap();
        }
        if value == SLOW && matches!(self.mode, RunMode::Live(_)) {
            let (kind, message) = (FaultKind::Deadline, "too slow".to_owned());
            let fault = Fault { kind, message, used: None, allowed: None };
            return WakeOutcome { result: Err(fault), fuel: None, run_ns: None, model_ns: None };
        }
        self.sum = Some(sum);
        WakeOutcome { result: Ok(()), fuel: Some(7), run_ns: None, model_ns: None }
    }

    fn discard(&mut self) {
        self.sum = None;
    }

    fn engine(&self) -> LambdaEngine {
        LambdaEngine { name: "a test".to_owned(), models: Vec::new() }
    }
}

/// Loads the lambda, which counts its wakes in `wakes`.
fn load(
    wakes: Arc<AtomicU64>,
) -> impl FnMut(&ConfiguredLambda, &Manifest, Session, RunMode) -> Result<Box<dyn Guest>, Failure> {
    move |_, _, session, mode| {
        Ok(Box::new(AddingGuest { session, mode, sum: None, wakes: Arc::clone(&wakes) }) as _)
    }
}

/// A run with its recorder.
pub struct RecordedRun {
    folder: TempDir,
    loopback: Loopback,
    clock: Clock,
    stop: Arc<AtomicBool>,
    control: ControlClient,
    run: ProgramThread<Exit>,
    recorder: ProgramThread<()>,
    ingress: IngressControl,
    ingress_thread: Option<JoinHandle<()>>,
    sent: [u64; 2],
    wakes: Arc<AtomicU64>,
}

/// The thread of a program, with its reports and the socket of its starter.
struct ProgramThread<T> {
    thread: JoinHandle<Result<T, Failure>>,
    reports: BufReader<PipeReader>,
    handover: UnixStream,
}

impl<T: Send + 'static> ProgramThread<T> {
    /// Starts `program`, which gets the pipe for its reports and a socket to its starter.
    fn start(program: impl FnOnce(File, OwnedFd) -> Result<T, Failure> + Send + 'static) -> Self {
        let (reports, to_reports) = pipe().unwrap();
        let (handover, starter) = UnixStream::pair().unwrap();
        let to_reports = File::from(OwnedFd::from(to_reports));
        let thread = thread::spawn(move || program(to_reports, starter.into()));
        Self { thread, reports: BufReader::new(reports), handover }
    }
}

impl RecordedRun {
    /// Starts both, and waits until the recorder receives the topic of numbers.
    pub fn start() -> Self {
        Self::start_after(0, 0)
    }

    /// As [`start`](Self::start). The recorder alone receives `earlier` numbers; then the topics of
    /// the lambda are attached, and `early` numbers are received before it is started.
    pub fn start_after(earlier: i64, early: i64) -> Self {
        let folder = TempDir::new().unwrap();
        let lambda = build(folder.path());
        let (loopback, clock, stop) =
            (Loopback::new(), Clock::from_time_of_day(), Arc::<AtomicBool>::default());
        add_topics(&loopback);
        let (mut control, stdin) = ControlClient::pair().unwrap();
        let (reports, reported) = sync_channel(64);
        let send = move |report| drop(reports.try_send(report));
        let source = Box::new(loopback.clone());
        let (mut ingress, ingress_thread) = Ingress::start_with_reports(source, send).unwrap();
        let reader = recorder(vec![grant(TOPICS[0])]);
        let (socket, stopped) = (ingress.add_reader(&reader).unwrap(), Arc::clone(&stop));
        let options = recorder_options(folder.path().join("out"), clock);
        let recorder = ProgramThread::start(move |reports, starter| {
            let connections = RecorderConnections {
                control: stdin,
                ingress: socket,
                starter: Some(starter),
                signer: None,
            };
            record(options, connections, reports, stopped)
        });
        let add = AddLambda {
            lambda: lambda.clone(),
            remaps: Vec::new(),
            most: Limits::MAX,
            grants: TOPICS.map(|(topic, id)| (topic.to_owned(), id)).to_vec(),
        };
        let near = control.add(&add).unwrap();
        let manifest = Manifest::parse(MANIFEST, "lambda.toml").unwrap();
        let reader = adder(&manifest);
        let mut sent = [0; 2];
        if earlier > 0 {
            wait_for_readers(&reported, 1, &TOPICS[..1]);
            (1..=earlier)
                .for_each(|value| publish(&loopback, clock, &mut sent, "/numbers", -value, 8));
        }
        let (socket, stopped) = (ingress.add_reader(&reader).unwrap(), Arc::clone(&stop));
        if early > 0 {
            wait_for_readers(&reported, 2, &TOPICS[..1]);
            (1..=early)
                .for_each(|value| publish(&loopback, clock, &mut sent, "/numbers", value, 8));
        }
        let wakes = Arc::<AtomicU64>::default();
        let counted = Arc::clone(&wakes);
        let run = ProgramThread::start(move |reports, starter| {
            let heartbeat = Heartbeat::create().unwrap().0;
            let nowhere = File::options().write(true).open("/dev/null").unwrap();
            let run = LiveRun {
                lambda: configured(&lambda),
                manifest,
                settings: live_settings(lambda, clock),
                feed: Feed::connect(socket).unwrap(),
                starter: Some(starter),
                recorder: Some(near),
                results: ResultsPipe::over(nowhere, heartbeat.clone()),
                heartbeat,
                close: &mut || Ok(Vec::new()),
                stop: &stopped,
            };
            run.run(&mut load(counted), reports)
        });
        let mut running = Self {
            folder,
            loopback,
            clock,
            stop,
            control,
            run,
            recorder,
            ingress,
            ingress_thread: Some(ingress_thread),
            sent,
            wakes,
        };
        until(&mut running.run.reports, |report| matches!(report, Report::Ready).then_some(()));
        running.recorder_has("/numbers");
        running
    }

    /// Ends the ingress, publishes `lost` samples of each topic, and starts the ingress again.
    /// Between the recorder and the lambda, `first` other samples are received.
    pub fn restart_ingress(&mut self, lost: u64, first: i64) {
        let (reports, reported) = sync_channel(64);
        let (control, ended) = IngressControl::pair().unwrap();
        drop((std::mem::replace(&mut self.ingress, control), ended));
        let ended = self.ingress_thread.take().unwrap();
        ended.join().unwrap();
        // The next ingress subscribes them again.
        add_topics(&self.loopback);
        self.sent.iter_mut().for_each(|sent| *sent += lost);
        let source = Box::new(self.loopback.clone());
        let send = move |report| drop(reports.try_send(report));
        let (control, thread) = Ingress::start_with_reports(source, send).unwrap();
        (self.ingress, self.ingress_thread) = (control, Some(thread));
        let manifest = Manifest::parse(MANIFEST, "lambda.toml").unwrap();
        let recorder = recorder(TOPICS.map(grant).to_vec());
        for (mut reader, index) in [recorder, adder(&manifest)].into_iter().zip(0..) {
            reader.topics = reader.topics.into_iter().map(|topic| topic.again(true)).collect();
            let ingress = Some(self.ingress.add_reader(&reader).unwrap());
            let handover = [&self.recorder.handover, &self.run.handover][index];
            Handover { ingress, ..Handover::default() }.try_send(handover).unwrap();
            wait_for_readers(&reported, index + 1, &TOPICS);
            if index == 0 {
                (1..=first).for_each(|value| self.publish("/others", value, 8));
            }
        }
    }

    /// Lets the recorder receive the other topic, too.
    pub fn record_others(&mut self) {
        let topics = vec![grant(TOPICS[1])];
        let add = AddTopics { reader: "recorder".to_owned(), topics };
        self.ingress.add_topics(&add).unwrap();
        self.recorder_has("/others");
    }

    fn recorder_has(&mut self, topic: &str) {
        until(&mut self.recorder.reports, |report| {
            let RecorderReport::Status(status) = report else { return None };
            let is_known =
                |known: &RecordedTopic| known.topic == topic && known.type_name.is_some();
            status.topics.iter().any(is_known).then_some(())
        });
    }

    pub fn publish(&mut self, topic: &str, value: i64, len: usize) {
        publish(&self.loopback, self.clock, &mut self.sent, topic, value, len);
    }

    /// Makes the next samples those that were sent last.
    pub fn send_last_again(&mut self) {
        self.sent.iter_mut().for_each(|sent| *sent -= 1);
    }

    /// Publishes a number that wakes the lambda, and waits for the wake.
    pub fn wake(&mut self, value: i64) {
        let before = self.wakes.load(Ordering::Relaxed);
        self.publish("/numbers", value, 8);
        let until = Instant::now() + Duration::from_secs(60);
        while self.wakes.load(Ordering::Relaxed) == before {
            assert!(Instant::now() < until, "the lambda is not woken");
            thread::yield_now();
        }
    }

    /// Publishes a number on each topic, `n` times, and then one that triggers.
    pub fn burst(&mut self, n: i64) {
        for value in 1..=n {
            self.publish("/others", value, 8);
            self.wake(value);
        }
        self.wake(TRIGGER);
    }

    /// Waits for the clip, ends everything, and returns the clip's file.
    pub fn clip(&mut self) -> PathBuf {
        let clip = self.next_clip();
        self.file_of(&clip)
    }

    pub fn next_clip(&mut self) -> Clip {
        until(&mut self.recorder.reports, |report| match report {
            RecorderReport::Clip(clip) => Some(*clip),
            _ => None,
        })
    }

    pub fn file_of(&self, clip: &Clip) -> PathBuf {
        self.folder.path().join("out").join(&clip.file)
    }

    pub fn verify(&self, clip: PathBuf) -> Result<Verified, Failure> {
        let lambda = self.folder.path().join("adder");
        let mut reports = Vec::new();
        let job = ReplayJob::verify(VerifyArgs {
            clip,
            lambda,
            vehicle: None,
            starter_passes_inference: false,
        })?;
        assert_eq!(job.run(&mut load(Arc::default()), &mut reports)?, Exit::Ok);
        match serde_json::from_slice(&reports).unwrap() {
            Report::Verified(verified) => Ok(verified),
            other => panic!("{other:?}"),
        }
    }

    pub fn end(self) {
        self.stop.store(true, Ordering::Relaxed);
        drop(self.control);
        self.run.thread.join().unwrap().unwrap();
        self.recorder.thread.join().unwrap().unwrap();
    }
}

/// Writes the build of the lambda into `folder`; returns the lambda's folder.
fn build(folder: &Path) -> PathBuf {
    let lambda = folder.join("adder");
    fs::create_dir_all(lambda.join("build")).unwrap();
    fs::write(lambda.join("build/lambda.toml"), MANIFEST).unwrap();
    fs::write(lambda.join("build/adder.wasm"), "x").unwrap();
    lambda
}

fn recorder_options(out: PathBuf, clock: Clock) -> RecorderOptions {
    RecorderOptions {
        out,
        clock,
        messages: Sources::default(),
        preroll_bytes: None,
        disk_floor: 0,
        clips_max: None,
        bytes_max: None,
        commands: None,
    }
}

fn live_settings(out: PathBuf, clock: Clock) -> Settings {
    Settings { out, all: false, restarts: 0, clock, round_trip: None, announce: None }
}

/// Waits until each of `topics` has so many readers.
fn wait_for_readers(reports: &Receiver<IngressReport>, count: usize, topics: &[(&str, u32)]) {
    let has_all = |known: &IngressTopic| known.readers == count;
    let is_it = |status: &IngressStatus| {
        topics.iter().all(|(topic, _)| {
            status.topics.iter().any(|known| known.topic == *topic && has_all(known))
        })
    };
    while !matches!(reports.recv().unwrap(), IngressReport::Status(status) if is_it(&status)) {}
}

/// Publishes a sample of `len` bytes. `sent` has the number of samples of each topic so far.
fn publish(
    loopback: &Loopback,
    clock: Clock,
    sent: &mut [u64; 2],
    topic: &str,
    value: i64,
    len: usize,
) {
    let sent = &mut sent[usize::from(topic == "/others")];
    *sent += 1;
    let at_ns = clock.now();
    let writer = Guid([7; 16]);
    let meta = SampleMeta { publish_ns: at_ns - 5, writer, ..crate::meta(at_ns, *sent) };
    let mut cdr = value.to_le_bytes().to_vec();
    cdr.resize(len, 0);
    loopback.publish(topic, &meta, &cdr).unwrap();
}

fn add_topics(loopback: &Loopback) {
    for (topic, _) in TOPICS {
        loopback.add_topic(topic, "test_msgs/msg/Number", "int64 value\n");
    }
}

fn recorder(topics: Vec<TopicGrant>) -> AddReader {
    AddReader { name: "recorder".to_owned(), topics, publishes: Vec::new() }
}

fn adder(manifest: &Manifest) -> AddReader {
    let inputs = manifest.inputs.iter().zip(0..);
    let topics = inputs
        .map(|(input, id)| TopicGrant::for_input(id, input, input.topic.as_str(), id == 0, true));
    AddReader { name: "adder".to_owned(), topics: topics.collect(), publishes: Vec::new() }
}

fn grant((topic, id): (&str, u32)) -> TopicGrant {
    recorded_grant(id, topic, Some("test_msgs/msg/Number".to_owned()), Some(64 << 10), Qos::Auto)
}

pub fn configured(lambda: &Path) -> ConfiguredLambda {
    ConfiguredLambda {
        build: BuildDir::of(lambda),
        folder: lambda.to_owned(),
        config: Vec::new(),
        remaps: Vec::new(),
        vehicle: None,
        models: Models::default(),
        passes_inference: false,
    }
}

/// Reads reports until `looked_for` accepts one.
pub fn until<R: serde::de::DeserializeOwned, T>(
    reports: &mut BufReader<PipeReader>,
    mut looked_for: impl FnMut(R) -> Option<T>,
) -> T {
    // There is a report each second.
    let until = Instant::now() + Duration::from_secs(60);
    loop {
        let mut line = String::new();
        assert!(reports.read_line(&mut line).unwrap() > 0, "the reports end");
        assert!(Instant::now() < until, "it is not reported");
        if let Some(found) = looked_for(serde_json::from_str(&line).unwrap()) {
            return found;
        }
    }
}
