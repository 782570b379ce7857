//! A simulated vehicle: keeps its connection as a real one does, reports, and sends records.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use gleaner_fleet::{
    Ack, Body, Desired, FRAME_MAX, Frame, GoAway, Hello, PROTOCOL, Ping, Pong, Records, Reported,
    Wanted, Welcome, compress,
};
use gleaner_trust::{unverified_deployment, unverified_revision};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use crate::identity::SimulatedIdentity;
use crate::simulation::{FleetLoad, Simulation, random_part};

/// The stream of all records.
const STREAM: &str = "events";
/// Time to connect, and for an answer, as of a real vehicle.
const PATIENCE: Duration = Duration::from_secs(30);
/// Longest pause before the first further attempt, as of a real vehicle.
const PAUSE: Duration = Duration::from_secs(1);
/// Time between reports of a vehicle where nothing happens.
const REPORT_IDLE: Duration = Duration::from_secs(60);
/// Number of the ping by which a vehicle learns that its frames so far were handled.
const SETTLE: u64 = 1 << 40;

type Socket = WebSocketStream<TlsStream<TcpStream>>;

/// A vehicle between connections.
pub struct SimulatedVehicle {
    identity: SimulatedIdentity,
    simulation: Arc<Simulation>,
    load: watch::Receiver<FleetLoad>,
    /// The number of the next record, and of the first one that is not acknowledged.
    next: u64,
    acknowledged: u64,
    /// The batch that was sent and not acknowledged: its end, and the time.
    waiting: Option<(u64, Instant)>,
    /// Each deployment that runs: id, envelope, release and digest of its revision.
    runs: Vec<RunningRelease>,
    /// Numbers of the last desired state, and of the one that was applied.
    received: u64,
    handled: u64,
}

#[derive(Clone)]
struct RunningRelease {
    id: String,
    envelope: String,
    release: u64,
    revision: String,
}

impl SimulatedVehicle {
    pub fn new(identity: SimulatedIdentity, simulation: Arc<Simulation>) -> Self {
        let load = simulation.load.subscribe();
        let (next, acknowledged, waiting) = (0, 0, None);
        let (runs, received, handled) = (vec![], 0, 0);
        Self { identity, simulation, load, next, acknowledged, waiting, runs, received, handled }
    }

    /// Keeps a connection for as long as the bench runs, and pauses after each end as a real
    /// vehicle does.
    pub async fn run(mut self) {
        let mut pause = PAUSE;
        let mut lost_at = None;
        loop {
            let begun = Instant::now();
            let end = self.connection(&mut lost_at).await;
            let is_restarting = self.simulation.is_restarting.load(Relaxed);
            let wait = match end {
                Ok(away) => Duration::from_millis(away.after_ms) + random_part(PAUSE),
                Err(reason) => {
                    if !is_restarting {
                        self.simulation.error(format!("{}: {reason}", self.identity.name));
                    }
                    pause = match begun.elapsed() > PATIENCE {
                        true => PAUSE,
                        false => (pause * 2).min(self.simulation.pause_max),
                    };
                    random_part(pause)
                }
            };
            sleep(wait).await;
        }
    }

    /// Opens a connection, and serves it until its end.
    async fn connection(&mut self, lost_at: &mut Option<Instant>) -> Result<GoAway, String> {
        let (mut socket, welcome) = timeout(PATIENCE, open(&self.identity, &self.simulation))
            .await
            .map_err(|_| "no connection within 30 s".to_owned())??;
        let position = welcome.cursors.iter().find(|it| it.stream == STREAM);
        let position = position.map_or(0, |it| it.next);
        if position < self.acknowledged || position > self.next {
            let Self { acknowledged, next, .. } = self;
            self.simulation.loss(format!(
                "{}: the cloud has records to {position}; {acknowledged} were acknowledged and \
                 {next} sent",
                self.identity.name
            ));
        }
        // What was sent and is not there is sent again.
        (self.next, self.acknowledged, self.waiting) = (position, position, None);
        if let Some(at) = lost_at.take() {
            self.simulation.reconnected(Instant::now() - at);
        }
        self.simulation.connected.fetch_add(1, Relaxed);
        let end = self.serve(&mut socket, welcome.ping_s).await;
        self.simulation.connected.fetch_sub(1, Relaxed);
        *lost_at = Some(Instant::now());
        end
    }

    async fn serve(&mut self, socket: &mut Socket, ping_s: u32) -> Result<GoAway, String> {
        let ping = Duration::from_secs(ping_s.into());
        let mut load = *self.load.borrow_and_update();
        let now = Instant::now();
        // At different times, as vehicles of a fleet do.
        let mut ping_at = now + random_part(ping);
        let mut batch_at = now + random_part(load.interval.unwrap_or_default());
        let mut silent_at = now + 3 * ping;
        self.report(socket).await?;
        let mut report_at = now + random_part(load.interval.unwrap_or(REPORT_IDLE));
        loop {
            let due = match load.interval {
                Some(_) => ping_at.min(report_at).min(batch_at),
                None => ping_at.min(report_at),
            };
            tokio::select! {
                message = socket.next() => {
                    silent_at = Instant::now() + 3 * ping;
                    if let Some(away) = self.handle(socket, message).await? {
                        return Ok(away);
                    }
                }
                () = sleep_until(due.min(silent_at)) => {
                    let now = Instant::now();
                    if now >= silent_at {
                        return Err("the cloud is silent".to_owned());
                    }
                    if now >= ping_at {
                        ping_at = now + ping;
                        send(socket, Body::Ping(Ping::default())).await?;
                    }
                    if now >= report_at {
                        report_at = now + load.interval.unwrap_or(REPORT_IDLE);
                        self.report(socket).await?;
                    }
                    if let Some(interval) = load.interval && now >= batch_at {
                        batch_at = now + interval;
                        self.send_records(socket, load.records).await?;
                    }
                }
                _ = self.load.changed() => {
                    load = *self.load.borrow_and_update();
                    let interval = load.interval.unwrap_or_default();
                    batch_at = Instant::now() + random_part(interval);
                    report_at = Instant::now() + random_part(load.interval.unwrap_or(REPORT_IDLE));
                }
            }
        }
    }

    async fn handle(
        &mut self,
        socket: &mut Socket,
        message: Option<Result<Message, tokio_tungstenite::tungstenite::Error>>,
    ) -> Result<Option<GoAway>, String> {
        match body(message)? {
            Some(Body::Desired(desired)) => self.apply(socket, desired).await?,
            Some(Body::Ack(ack)) => self.acknowledge(&ack),
            Some(Body::Ping(Ping { number })) => send(socket, Body::Pong(Pong { number })).await?,
            Some(Body::Pong(Pong { number: SETTLE })) => {
                self.simulation.applied(self.runs.iter().map(|it| it.release).max());
            }
            Some(Body::GoAway(away)) => return Ok(Some(away)),
            _ => {}
        }
        Ok(None)
    }

    /// Fetches the deployments of a desired state that are new, over one connection as real ones
    /// do, and reports that they run. Nothing is verified and nothing starts.
    async fn apply(&mut self, socket: &mut Socket, desired: Desired) -> Result<(), String> {
        let simulation = Arc::clone(&self.simulation);
        let Desired { generation, deployments, .. } = desired;
        if generation < self.received {
            let Self { identity, received, .. } = self;
            simulation
                .error(format!("{}: desired state {generation} after {received}", identity.name));
        }
        self.received = generation;
        let wanted: Vec<_> = deployments.into_iter().filter(|it| it.is_wanted).collect();
        simulation.wants(&self.identity.name, wanted.first().map_or("", |it| &it.envelope));
        let turn = simulation.files.acquire().await.map_err(|error| error.to_string())?;
        let (mut runs, mut files) = (Vec::new(), None);
        for Wanted { id, envelope, .. } in wanted {
            if let Some(same) = self.runs.iter().find(|it| it.envelope == envelope) {
                runs.push(same.clone());
                continue;
            }
            let address = self.simulation.address;
            let mut get = async |path: String| self.identity.get(&mut files, address, &path).await;
            let sealed = get(format!("/v1/deployments/{envelope}")).await?;
            let deployment = unverified_deployment(&sealed).map_err(|error| error.to_string())?;
            let sealed = get(format!("/v1/revisions/{}", deployment.revision)).await?;
            let (revision, digest) =
                unverified_revision(&sealed).map_err(|error| error.to_string())?;
            for file in &revision.files {
                get(format!("/v1/objects/{}", file.sha256)).await?;
            }
            let (release, revision) = (deployment.release, digest.to_string());
            runs.push(RunningRelease { id, envelope, release, revision });
        }
        drop((files, turn));
        (self.runs, self.handled) = (runs, generation);
        self.report(socket).await?;
        send(socket, Body::Ping(Ping { number: SETTLE })).await
    }

    fn acknowledge(&mut self, ack: &Ack) {
        let Some((end, sent)) = self.waiting.take() else {
            return self.simulation.error("an acknowledgement of nothing".to_owned());
        };
        if ack.next < end {
            self.simulation.error(format!("{} of {end} acknowledged", ack.next));
        }
        self.acknowledged = ack.next;
        self.simulation.acknowledged(&self.identity.name, ack.next, sent.elapsed());
    }

    /// Sends the next records, unless some are on their way.
    async fn send_records(&mut self, socket: &mut Socket, count: u64) -> Result<(), String> {
        if self.waiting.is_some() {
            return Ok(());
        }
        let mut lines = Vec::new();
        for seq in self.next..self.next + count {
            let line = json!({
                "stream": STREAM, "seq": seq, "time_ns": seq * 1_000_000, "boot_ns": seq,
                "boot": "0123456789abcdef0123456789abcdef", "kind": "event",
                "record": { "text": format!("lambda `brake-dark` has triggered a clip, {seq}") },
            });
            lines.extend(line.to_string().into_bytes());
            lines.push(b'\n');
        }
        self.next += count;
        self.waiting = Some((self.next, Instant::now()));
        let (stream, next) = (STREAM.to_owned(), self.next);
        send(socket, Body::Records(Records { stream, life: 1, next, lines: compress(&lines) }))
            .await
    }

    async fn report(&mut self, socket: &mut Socket) -> Result<(), String> {
        self.simulation.reports.fetch_add(1, Relaxed);
        let up_s = self.simulation.begun.elapsed().as_secs_f64();
        let status = status(&self.identity.name, up_s, self.handled, &self.runs);
        let status = compress(status.to_string().as_bytes());
        let reported = Reported { generation: self.handled, status, problems: Vec::new() };
        send(socket, Body::Reported(reported)).await
    }
}

/// Opens the control channel up to the welcome.
pub async fn open(
    identity: &SimulatedIdentity,
    simulation: &Simulation,
) -> Result<(Socket, Welcome), String> {
    let stream = identity.connect(simulation.address).await?;
    let config = WebSocketConfig::default()
        .read_buffer_size(4096)
        .write_buffer_size(0)
        .max_message_size(Some(FRAME_MAX))
        .max_frame_size(Some(FRAME_MAX));
    let opened =
        tokio_tungstenite::client_async_with_config("ws://cloud/v1/link", stream, Some(config));
    let (mut socket, _) = opened.await.map_err(|error| error.to_string())?;
    let (version, key) = ("0.1.0".to_owned(), "key".to_owned());
    let hello = Hello { protocol: PROTOCOL, version, key, ..Hello::default() };
    send(&mut socket, Body::Hello(hello)).await?;
    match body(socket.next().await)? {
        Some(Body::Welcome(welcome)) => Ok((socket, welcome)),
        Some(Body::GoAway(away)) => Err(away.reason),
        _ => Err("the cloud did not begin with `Welcome`".to_owned()),
    }
}

/// Keeps a connection without a sign of life until the cloud ends it; returns the reason.
pub async fn be_silent(
    identity: &SimulatedIdentity,
    simulation: &Simulation,
) -> Result<String, String> {
    let (mut socket, _) = open(identity, simulation).await?;
    loop {
        if let Some(Body::GoAway(away)) = body(socket.next().await)? {
            return Ok(away.reason);
        }
    }
}

async fn send(socket: &mut Socket, body: Body) -> Result<(), String> {
    let frame = Message::Binary(Frame::encoded(body).into());
    let sent = timeout(PATIENCE, socket.send(frame)).await;
    sent.map_err(|_| "a frame is not sent within 30 s".to_owned())?
        .map_err(|error| error.to_string())
}

fn body(
    message: Option<Result<Message, tokio_tungstenite::tungstenite::Error>>,
) -> Result<Option<Body>, String> {
    match message {
        Some(Ok(Message::Binary(bytes))) => {
            Ok(Frame::decoded(&bytes).map_err(|error| error.to_string())?.body)
        }
        None | Some(Ok(Message::Close(_))) => Err("the connection was closed".to_owned()),
        Some(Ok(_)) => Ok(None),
        Some(Err(error)) => Err(error.to_string()),
    }
}

/// Returns a status as a vehicle reports it, of some 1.5 kB.
fn status(name: &str, up_s: f64, generation: u64, runs: &[RunningRelease]) -> Value {
    let deployments = runs.iter().map(|RunningRelease { id, envelope, release, revision }| {
        json!({
            "id": id, "release": release, "envelope": envelope, "attempt": 1, "lambda": id,
            "revision": { "digest": revision, "version": "1.0.0", "release": 1 },
            "fallback": null, "grants": { "topics": [], "models": [], "record": false },
            "is_wanted": true, "runs_fallback": false, "is_proven": true, "failed": null,
            "refused": null, "stale": null,
            "status": { "id": id, "name": id, "revision": revision, "attempt": 1,
                "phase": "running", "phase_s": up_s, "pid": 4711, "restarts": 0, "last_end": null,
                "live": null, "layers": [] },
        })
    });
    json!({
        "vehicle": name, "key": "0123456789abcdef".repeat(4),
        "labels": { "fleet": "simulated", "model": "one", "year": "2026" },
        "orchestrator": { "version": "0.1.0", "pid": 4242, "up_s": up_s,
            "rss_bytes": 20_000_000 + up_s as u64, "cpu_s": up_s / 100.0 },
        "trust": null, "generation": generation, "deployments": deployments.collect::<Vec<_>>(),
        "capacity": [], "supervisor": null,
    })
}
