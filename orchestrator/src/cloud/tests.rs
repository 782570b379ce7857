//! A vehicle at a cloud that is hostile: what it sends is refused with a reason, or skipped, and
//! what runs is left alone.

use std::time::{Duration, Instant, SystemTime};

use gleaner_fleet::{
    Ack, Body, Cursor, Desired, Enrolment, FRAME_MAX, Frame, GoAway, Hello, Ping, Pong, Records,
    Reported, Tail, WANTED_MAX, Wanted, Welcome, decompress,
};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_protocol::vehicle_api::{Problem, StreamLine};
use gleaner_spool::{SpoolItem, SpoolReader};
use gleaner_trust::{
    Deployment, Grants, Labels, Payload, Revision, RevisionFile, RootKeys, ScopedKey, SecretKey,
    TrustRoot, seal, sha256,
};
use tempfile::TempDir;
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::task::JoinHandle;
use tokio_tungstenite::tungstenite::Message;

use super::fake_cloud::{ControlChannel, FakeAnswers, FakeCloud, soon};
use super::http::CloudHttp;
use super::reconcile::{Handled, Order, Reconciler};
use super::session::{CloudSession, SessionEnd};
use super::*;
use crate::orchestrator::Orchestrator;
use crate::spools::{self, SpoolFolders};

const DAY: u64 = 86_400;
const ROOT: u8 = 1;
const PUBLISHER: u8 = 2;
const DEPLOYER: u8 = 3;
const STRANGER: u8 = 4;
const MANIFEST: &str = "lambda = { name = 'brake', version = '0.2.0', kind = 'python', \
                        entry = 'main.py' }\nschedule.period = '1s'\n";

/// A vehicle that follows the desired states of a cloud.
struct LinkedVehicle {
    link: CloudLink,
    http: CloudHttp,
    orders: watch::Sender<Option<Order>>,
    handled: watch::Receiver<Handled>,
    settings: watch::Sender<Option<CloudSettings>>,
    answers: FakeAnswers,
    channels: UnboundedReceiver<ControlChannel>,
    _folder: TempDir,
}

type RunningSession = JoinHandle<Result<SessionEnd, Failure>>;

impl LinkedVehicle {
    async fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let mut vehicle = gleaner_lambda::Vehicle::default();
        vehicle.identity.labels = labels("berlin");
        let core = Orchestrator::in_folder(folder.path(), vehicle);
        let (cloud, _) = Cloud::load(DurableFile::new(core.layout.cloud()));
        let link = CloudLink { core: Arc::clone(&core), cloud };
        let (orders, received) = watch::channel(None);
        let (handled, results) = watch::channel(Handled::default());
        tokio::spawn(Reconciler { core, orders: received, handled, step: Arc::default() }.run());
        let (cloud, answers) = (FakeCloud::start().await, FakeAnswers::default());
        let http = cloud.http.clone();
        let settings = watch::Sender::new(Some(cloud.settings.clone()));
        let channels = cloud.serve(Arc::clone(&answers));
        let _folder = folder;
        Self { link, http, orders, handled: results, settings, answers, channels, _folder }
    }

    async fn open(&mut self) -> (RunningSession, ControlChannel) {
        let (link, http) = (self.link.clone(), self.http.clone());
        let (orders, handled) = (self.orders.clone(), self.handled.clone());
        let settings = self.settings.subscribe();
        let session = tokio::spawn(async move {
            let until = Instant::now() + Duration::from_secs(DAY);
            let (has_progress, dialing) = (&mut false, Duration::from_secs(60));
            let session = CloudSession {
                core: &link.core,
                cloud: &link.cloud,
                http: &http,
                orders: &orders,
                handled,
                until,
                dialing,
                has_progress,
            };
            session.run(settings).await
        });
        (session, soon(self.channels.recv()).await.unwrap())
    }

    /// Opens a connection, with this answer to the first frame.
    async fn connect(&mut self, welcome: Welcome) -> (RunningSession, ControlChannel) {
        let (session, mut channel) = self.open().await;
        channel.send(Body::Welcome(welcome)).await;
        (session, channel)
    }

    fn answer(&self, path: String, body: Vec<u8>) {
        let head = format!("200 OK\r\ncontent-length: {}", body.len());
        self.answers.lock().unwrap().insert(path, (head, body));
    }

    /// Puts a deployment with all that belongs to it into the cloud.
    fn offer(&self, deployment: &Deployment, deployer: u8, revision: Vec<u8>) -> Wanted {
        let envelope = seal(deployment, &[&key(deployer)]).unwrap();
        let wanted = wanted(deployment.id.as_str(), &envelope);
        self.answer(format!("/v1/deployments/{}", wanted.envelope), envelope);
        self.answer(format!("/v1/revisions/{}", deployment.revision), revision);
        wanted
    }

    /// Waits for an event with these words; returns the number of those that are durable then.
    async fn events(&self, words: &str) -> usize {
        let folder = self.link.core.layout.spool().join("orchestrator");
        let has_words = |item: &Result<SpoolItem, _>| match item {
            Ok(SpoolItem::Record(it)) => String::from_utf8_lossy(&it.payload).contains(words),
            _ => false,
        };
        soon(async {
            loop {
                let events = SpoolReader::open(&folder, "orchestrator", None).unwrap();
                match events.filter(has_words).count() {
                    0 => tokio::time::sleep(Duration::from_millis(2)).await,
                    found => return found,
                }
            }
        })
        .await
    }

    /// Returns what is deployed, and what the supervisor is to run.
    fn runs(&self) -> String {
        let deployments = self.link.core.lock().state.deployments.clone();
        format!("{deployments:?} {:?}", self.link.core.desired().borrow().lambdas)
    }
}

fn labels(site: &str) -> Labels {
    [("site".parse().unwrap(), site.to_owned())].into()
}

fn key(seed: u8) -> SecretKey {
    SecretKey::from_bytes(&[seed; 32])
}

fn now() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs()
}

fn root(version: u64, expires: u64) -> Vec<u8> {
    let scoped = |seed| {
        let lambdas = vec!["*".parse().unwrap()];
        vec![ScopedKey { key: key(seed).public(), lambdas, labels: Labels::new() }]
    };
    let root = TrustRoot {
        version,
        created: 1,
        expires,
        root: RootKeys { threshold: 1, keys: vec![key(ROOT).public()] },
        publishers: scoped(PUBLISHER),
        deployers: scoped(DEPLOYER),
    };
    seal(&root, &[&key(ROOT)]).unwrap()
}

fn revision(release: u64, code: &str) -> Revision {
    let file = |(path, content): (&str, &str)| RevisionFile {
        path: path.parse().unwrap(),
        bytes: content.len() as u64,
        sha256: sha256(content.as_bytes()),
    };
    Revision {
        name: "brake".parse().unwrap(),
        version: "0.2.0".parse().unwrap(),
        kind: LambdaKind::Python,
        release,
        created: 1,
        files: [("lambda.toml", MANIFEST), ("main.py", code)].map(file).into(),
    }
}

fn deployment(release: u64, revision: &Revision) -> Deployment {
    Deployment {
        id: "front".parse().unwrap(),
        release,
        selector: labels("berlin"),
        revision: sha256(&serde_json::to_vec(revision).unwrap()),
        fallback: None,
        config: [].into(),
        grants: Grants::default(),
        created: 1,
        expires: now() + DAY,
    }
}

fn wanted(id: &str, envelope: &[u8]) -> Wanted {
    let envelope = sha256(envelope).to_string();
    Wanted { id: id.to_owned(), envelope, is_wanted: true, rollback: 0, start: 0 }
}

fn frame(body: Body) -> Message {
    Message::Binary(Frame::encoded(body).into())
}

#[tokio::test]
#[expect(clippy::too_many_lines, reason = "one list of all cases, which share their helpers")]
async fn a_wanted_state_that_is_not_accepted_is_refused_and_what_runs_is_left_alone() {
    let mut vehicle = LinkedVehicle::new().await;
    vehicle.link.core.install_root(&root(1, now() + DAY)).unwrap();
    let [first, second] = [revision(1, "x = 0\n"), revision(2, "x = 1\n")];
    for content in [MANIFEST, "x = 0\n"] {
        let content = content.as_bytes().to_vec();
        vehicle.answer(format!("/v1/objects/{}", sha256(&content)), content);
    }
    let [signed, newer] = [&first, &second].map(|it| seal(it, &[&key(PUBLISHER)]).unwrap());
    let (_session, mut channel) = vehicle.connect(Welcome::default()).await;
    let good = vehicle.offer(&deployment(5, &first), DEPLOYER, signed.clone());
    let state =
        |generation, deployments| Body::Desired(Desired { generation, deployments, keeps: false });
    channel.send(state(1, vec![good.clone()])).await;
    assert_eq!(channel.reported(1).await.problems, Vec::new());
    let runs = vehicle.runs();
    assert!(runs.contains("front"), "{runs}");

    let by = |change: fn(&mut Deployment), deployer| {
        let mut deployment = deployment(6, &first);
        change(&mut deployment);
        vehicle.offer(&deployment, deployer, signed.clone())
    };
    let of_second = |revision| vehicle.offer(&deployment(7, &second), DEPLOYER, revision);
    let swapped = |wanted: Wanted, head: &str, body: Vec<u8>| {
        let path = format!("/v1/deployments/{}", wanted.envelope);
        vehicle.answers.lock().unwrap().insert(path, (head.to_owned(), body));
        wanted
    };
    let named = |wanted: Wanted, id: &str| Wanted { id: id.to_owned(), ..wanted };
    // Each is prepared when it is sent: some change what is under the same path.
    type Prepare<'p> = Box<dyn Fn() -> Wanted + 'p>;
    let cases: Vec<(Prepare<'_>, &str)> = vec![
        (
            Box::new(|| by(|it| it.release = 4, DEPLOYER)),
            "release 4; release 5 was accepted before",
        ),
        (
            Box::new(|| by(|it| (it.release, it.created) = (5, 2), DEPLOYER)),
            "was accepted before with release 5",
        ),
        (Box::new(|| by(|_| {}, STRANGER)), "the deployment is signed by"),
        (Box::new(|| by(|it| it.selector = labels("paris"), DEPLOYER)), "`site` = `paris`"),
        (Box::new(|| by(|it| it.expires = now() - 1, DEPLOYER)), "the deployment expired at"),
        (Box::new(|| named(by(|_| {}, DEPLOYER), "rear")), "names deployment `front` `rear`"),
        (Box::new(|| named(by(|_| {}, DEPLOYER), "../front\u{1b}")), "invalid deployment id"),
        (Box::new(|| wanted("rear", b"nowhere")), "404"),
        (
            Box::new(|| Wanted { envelope: "../x y".to_owned(), ..good.clone() }),
            "a request to it is invalid",
        ),
        (
            Box::new(|| {
                let wanted = wanted("front", b"\xff");
                swapped(wanted, "200 OK\r\ncontent-length: 1", b"\xff".to_vec())
            }),
            "the deployment is malformed",
        ),
        (
            Box::new(|| {
                let other = seal(&deployment(9, &first), &[&key(DEPLOYER)]).unwrap();
                swapped(by(|it| it.release = 8, DEPLOYER), "200 OK", other)
            }),
            "another deployment than it wants",
        ),
        (
            Box::new(|| {
                let endless = vec![b' '; Deployment::MAX.bytes() as usize + 1];
                swapped(by(|it| it.release = 8, DEPLOYER), "200 OK", endless)
            }),
            "it has more than 1048576 bytes",
        ),
        (
            Box::new(|| of_second(seal(&second, &[&key(STRANGER)]).unwrap())),
            "the revision is signed by",
        ),
        (Box::new(|| of_second(signed.clone())), "of the deployment is unknown here"),
        (
            Box::new(|| {
                vehicle.answer(format!("/v1/objects/{}", sha256(b"x = 1\n")), b"x = 2\n".to_vec());
                of_second(newer.clone())
            }),
            "the SHA-256",
        ),
    ];
    let mut generation = 1;
    for (prepare, expected) in cases {
        generation += 1;
        let wish = prepare();
        let deployments = if wish.id == "front" { vec![wish] } else { vec![good.clone(), wish] };
        channel.send(state(generation, deployments)).await;
        let problems = channel.reported(generation).await.problems;
        assert!(problems.len() == 1 && problems[0].describe().contains(expected), "{expected}");
        let reason = problems[0].describe();
        assert!(!reason.contains('\u{1b}') && reason.len() < 1000, "{reason}");
        assert_eq!(vehicle.runs(), runs, "{expected}");
        vehicle.events(expected).await;
    }

    // A cloud that has lost what came since, or states that, takes nothing away.
    for (generation, keeps) in [(1, false), (generation, true)] {
        channel.send(Body::Desired(Desired { generation, deployments: vec![], keeps })).await;
        let problems = channel.reported(generation).await.problems;
        assert!(problems[0].is_pending && problems[0].title.contains("it stays on this vehicle"));
        assert_eq!(vehicle.runs(), runs);
    }
    // Neither does another cloud. Once it wants the same, it can end it.
    vehicle.link.core.leave_other_cloud("another").unwrap();
    channel.send(state(50, vec![])).await;
    assert_eq!(channel.reported(50).await.problems, Vec::new());
    assert!(vehicle.runs().contains("front"));
    channel.send(state(51, vec![good.clone()])).await;
    assert_eq!(channel.reported(51).await.problems, Vec::new());
    let runs = vehicle.runs();
    // What was accepted before the root expired runs on; nothing new is accepted.
    vehicle.link.core.install_root(&root(2, now() - 1)).unwrap();
    let new = by(|it| it.release = 10, DEPLOYER);
    channel.send(state(100, vec![new])).await;
    let problems = channel.reported(100).await.problems;
    assert!(problems[0].describe().contains("the trust root expired at"), "{problems:?}");
    assert_eq!(vehicle.runs(), runs);
    vehicle.events("the trust root expired at").await;
    // With the agreement of a user, a restored cloud has a newer state, which is followed.
    channel.send(state(101, vec![])).await;
    assert_eq!(channel.reported(101).await.problems, Vec::new());
    assert!(!vehicle.runs().contains("front"));
}

#[tokio::test]
async fn the_causes_and_the_help_of_a_refused_enrolment_are_kept() {
    let vehicle = LinkedVehicle::new().await;
    let help = "an enrolment works once, for 24 hours: make another one with `gleaner vehicles`";
    let mut refusal = Failure::new(Exit::Denied, "the enrolment is not valid").with_help(help);
    refusal.causes = vec!["it was used\u{1b}[2J".to_owned(), "x".repeat(10_000)];
    let body = serde_json::to_vec(&Problem::new(refusal, 403)).unwrap();
    let head = format!("403 Forbidden\r\ncontent-length: {}", body.len());
    vehicle.answers.lock().unwrap().insert("/v1/enrol".to_owned(), (head, body));
    let CloudSettings { address, authority, .. } = vehicle.settings.borrow().clone().unwrap();
    let (name, token) = ("car".to_owned(), "secret".to_owned());
    let enrolment = Enrolment { gleaner_enrolment: 1, address, vehicle: name, authority, token };
    let text = serde_json::to_vec(&enrolment).unwrap();
    let CloudLink { core, cloud } = &vehicle.link;
    let failure = soon(cloud.enrol(core, &text)).await.unwrap_err();
    assert_eq!(failure.causes[..2], ["the enrolment is not valid", r"it was used\u{1b}[2J"]);
    assert_eq!((failure.help.as_deref(), failure.causes[2].len()), (Some(help), 300));
}

#[tokio::test]
async fn frames_that_break_the_rules_end_a_connection_with_the_reason() {
    let mut vehicle = LinkedVehicle::new().await;
    let welcome = || frame(Body::Welcome(Welcome::default()));
    let away = |after_ms| {
        let reason = "away\u{1b}[31m".repeat(10_000);
        frame(Body::GoAway(GoAway { after_ms, reason }))
    };
    let many = vec![wanted("front", b""); WANTED_MAX + 1];
    let cases = [
        (vec![frame(Body::Desired(Desired::default()))], "it did not begin with `Welcome`"),
        (vec![Message::text("hello")], "it did not begin with `Welcome`"),
        (vec![Message::Binary(vec![0x0a, 0xff].into())], "a frame cannot be decoded"),
        (vec![welcome(), Message::Binary(vec![0xff; 100].into())], "a frame cannot be decoded"),
        (vec![welcome(), Message::Binary(vec![0; FRAME_MAX + 1].into())], "too long"),
        (
            vec![
                welcome(),
                frame(Body::Desired(Desired { generation: 1, deployments: many, keeps: false })),
            ],
            "it wants more than 4000 deployments",
        ),
        (vec![welcome(), Message::Close(None)], "it closed the connection"),
    ];
    for (messages, expected) in cases {
        let (session, mut channel) = vehicle.open().await;
        for message in messages {
            channel.send_message(message).await;
        }
        let failure = soon(session).await.unwrap().unwrap_err();
        assert_eq!(failure.exit, Exit::Unreachable, "{failure}");
        let text = failure.to_string();
        assert!(text.contains(expected) && text.len() < 500, "{expected}: {text}");
        assert!(!text.contains('\u{1b}') && vehicle.orders.borrow().is_none(), "{text}");
    }
    // Also in the place of the first frame.
    for first in [None, Some(welcome())] {
        let (session, mut channel) = vehicle.open().await;
        for message in first.into_iter().chain([away(u64::MAX)]) {
            channel.send_message(message).await;
        }
        let Ok(SessionEnd::Away(after, reason)) = soon(session).await.unwrap() else { panic!() };
        assert_eq!(after, Duration::from_secs(3600));
        assert!(reason.starts_with("away") && reason.len() < 500, "{reason}");
    }
}

#[tokio::test]
async fn absurd_positions_and_endless_frames_change_nothing() {
    let mut vehicle = LinkedVehicle::new().await;
    let cursor = |stream: &str, number| Cursor {
        stream: stream.to_owned(),
        life: 7,
        next: number,
        seq: number - 1,
        boot: "no boot".to_owned(),
        boot_ns: number,
    };
    let unknown = (0..5000).map(|number| cursor(&format!("lambdas/{number}"), number + 1));
    let absurd = ["events", "", "../../state", "\0", &"x".repeat(500_000)];
    let absurd = absurd.map(|stream| cursor(stream, u64::MAX));
    let cursors = unknown.chain(absurd).chain([cursor("orchestrator", 1 << 40)]).collect();
    let welcome = Welcome { ping_s: u32::MAX, time_ms: i64::MIN, cursors, ..Welcome::default() };
    let (session, mut channel) = vehicle.connect(welcome).await;
    // It has no such record: everything is sent, as another life.
    let records = |body| match body {
        Body::Records(records) => Some(records),
        _ => None,
    };
    let batch = channel.until(records).await;
    assert_eq!((&*batch.stream, batch.life), ("orchestrator", 8));
    let lines = decompress(&batch.lines).unwrap();
    let first = lines.split(|byte| *byte == b'\n').next().unwrap();
    assert_eq!(serde_json::from_slice::<StreamLine>(first).unwrap().seq, 0);

    let ack = |stream: &str, life, next| Body::Ack(Ack { stream: stream.to_owned(), life, next });
    let streams = (0..50_000).map(|number| number.to_string()).collect();
    let skipped = [
        frame(Body::Welcome(Welcome::default())),
        frame(Body::Hello(Hello::default())),
        frame(Body::Reported(Reported { status: vec![0; 100_000], ..Reported::default() })),
        frame(Body::Records(Records { lines: vec![0; 100_000], ..Records::default() })),
        frame(Body::Pong(Pong { number: 7 })),
        frame(ack("orchestrator", 9, 1)),
        frame(ack("lambdas/unknown", 1, u64::MAX)),
        frame(ack(&"x".repeat(100_000), 1, 1)),
        frame(Body::Tail(Tail { streams, seconds: u32::MAX })),
        Message::Binary(vec![0xc2, 0x0c, 1, 0].into()),
        Message::text("text"),
        Message::Ping(vec![1].into()),
    ];
    for message in skipped {
        channel.send_message(message).await;
    }
    let deployments = |generation| {
        let ids = (0..300).map(|number| format!("../{generation}/{number}"));
        ids.map(|id| wanted(&id, b"")).collect()
    };
    for generation in 1..=500 {
        let deployments = deployments(generation);
        channel.send(Body::Desired(Desired { generation, deployments, keeps: false })).await;
        channel.send(Body::Ping(Ping { number: generation })).await;
    }
    let problems = channel.reported(500).await.problems;
    assert_eq!(problems[0].title, "invalid deployment id `../500/0`");
    assert!(problems.len() < 300, "a report has bounds");
    channel.send(Body::Ping(Ping { number: 9999 })).await;
    channel.until(|body| (body == Body::Pong(Pong { number: 9999 })).then_some(())).await;
    assert_eq!(vehicle.link.cloud.lock().state, LinkState::Connected);
    let spools = SpoolFolders(vehicle.link.core.layout.spool());
    assert!(spools::count(&spools).unsent > 0, "nothing was acknowledged");
    // It fills no log with them.
    vehicle.link.core.warn("the end");
    vehicle.events("the end").await;
    assert!((1..200).contains(&vehicle.events("invalid deployment id").await));
    assert!(vehicle.link.core.events.lost() == 0 && !session.is_finished());
}

#[tokio::test]
async fn after_garbage_the_vehicle_connects_again() {
    let mut vehicle = LinkedVehicle::new().await;
    let settings = vehicle.settings.borrow().clone().unwrap();
    vehicle.link.cloud.set(settings).unwrap();
    tokio::spawn(vehicle.link.clone().keep());
    let mut channel = soon(vehicle.channels.recv()).await.unwrap();
    channel.send_message(Message::Binary(vec![0xff; 100].into())).await;
    let reached = |state: &'static str, reason: &'static str| {
        let cloud = vehicle.link.cloud.clone();
        soon(async move {
            loop {
                let status = cloud.status().unwrap();
                if status.state == state && status.reason.unwrap_or_default().contains(reason) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        })
    };
    reached("connecting", "a frame cannot be decoded").await;
    let mut channel = soon(vehicle.channels.recv()).await.unwrap();
    channel.send(Body::Welcome(Welcome::default())).await;
    reached("connected", "").await;
}
