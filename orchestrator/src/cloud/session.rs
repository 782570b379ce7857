//! One connection to the cloud: frames in both directions, until it ends.

use std::sync::Arc;
use std::sync::mpsc as sync_mpsc;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use gleaner_base::{Exit, Failure, excerpt, hex};
use gleaner_fleet::{
    Body, Cursor, Desired, FRAME_MAX, Frame, GoAway, Hello, PROBLEMS_MAX, PROTOCOL, Ping, Pong,
    Reported, STATUS_STREAM, STREAM_NAME_MAX, WANTED_MAX, Welcome, compress,
};
use gleaner_spool::BootId;
use tokio::net::TcpStream;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, interval, sleep_until, timeout};
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use super::clip_list::ClipFolder;
use super::clips::ClipSender;
use super::collect::TailLease;
use super::http::{CloudHttp, PATIENCE};
use super::reconcile::{Handled, Order};
use super::settings::CloudSettings;
use super::uplink::{Uplink, UplinkOrder};
use super::{Cloud, LinkState};
use crate::orchestrator::Orchestrator;
use crate::spools::SpoolFolders;

/// Interval of looks whether the status is to be reported.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Time after which a connection that still receives something lasts.
const LASTING: Duration = Duration::from_secs(30);
/// Longest time between two reports.
const REPORT_MAX: Duration = Duration::from_secs(60);
/// Number of frames about records that wait for the thread that sends these. It has one batch of
/// each stream on its way, so that a cloud that follows the rules does not send more.
const UPLINK_ORDERS: usize = 4096;
const GENERATION_MAX: u64 = 1 << 60;
/// Bounds of the interval of signs of life, in s, whatever the cloud asks for.
const PING_S: std::ops::RangeInclusive<u32> = 5..=300;

pub(super) struct CloudSession<'s> {
    pub(super) core: &'s Arc<Orchestrator>,
    pub(super) cloud: &'s Cloud,
    pub(super) http: &'s CloudHttp,
    pub(super) orders: &'s watch::Sender<Option<Order>>,
    pub(super) handled: watch::Receiver<Handled>,
    /// Time at which it ends, as the certificate is to be renewed.
    pub(super) until: std::time::Instant,
    /// Longest time to reach the cloud, without the handshake.
    pub(super) dialing: Duration,
    /// Set once the cloud has acknowledged something or wants something new, or it lasts.
    pub(super) has_progress: &'s mut bool,
}

/// The tasks that receive the frames of a connection, until it ends.
struct SessionTasks {
    /// SHA-256 of the certificate of the cloud's authority.
    authority: String,
    /// To the thread that sends records.
    uplink: sync_mpsc::SyncSender<UplinkOrder>,
    /// To the task that sends clips: the number of the desired state.
    generation: watch::Sender<u64>,
    /// The streams that people read now.
    lease: TailLease,
    /// Ends the task that sends clips when it is dropped.
    _clips: JoinSet<()>,
}

#[derive(Debug)]
pub(super) enum SessionEnd {
    /// The cloud asks to connect again after this time, for this reason.
    Away(Duration, String),
    /// The enrolment was changed or ended, or the certificate is to be renewed.
    Changed,
}

impl SessionEnd {
    fn of(away: &GoAway) -> Self {
        // Not for ever, whatever the cloud asks for.
        let after = Duration::from_millis(away.after_ms.min(3_600_000));
        Self::Away(after, excerpt(&away.reason))
    }
}

type Socket = WebSocketStream<TlsStream<TcpStream>>;

impl CloudSession<'_> {
    /// Exchanges frames until the connection ends.
    pub(super) async fn run(
        mut self,
        mut settings: watch::Receiver<Option<CloudSettings>>,
    ) -> Result<SessionEnd, Failure> {
        let mut socket = self.open().await?;
        let authority = settings.borrow().as_ref().map(CloudSettings::authority_digest);
        let authority = authority.unwrap_or_default();
        let Welcome { ping_s, cursors, .. } = match self.first(&mut socket, &authority).await? {
            Some(Body::Welcome(welcome)) => welcome,
            Some(Body::GoAway(away)) => return Ok(SessionEnd::of(&away)),
            _ => return Err(self.lost("it did not begin with `Welcome`")),
        };
        self.cloud.set_state(LinkState::Connected, None, None);
        let (mut tasks, mut outgoing) = self.start(cursors, authority);
        let ping = Duration::from_secs((*PING_S.start()).max(ping_s.min(*PING_S.end())).into());
        let (mut pings, mut looks) = (interval(ping), interval(STATUS_INTERVAL));
        let began = Instant::now();
        let mut last_heard = began;
        let (mut reported, mut report_at) = (String::new(), Instant::now());
        loop {
            tokio::select! {
                message = socket.next() => {
                    last_heard = Instant::now();
                    *self.has_progress |= last_heard > began + LASTING;
                    match self.frame(message)? {
                        Some(Body::Ping(Ping { number })) => {
                            self.send(&mut socket, Body::Pong(Pong { number })).await?;
                        }
                        Some(Body::GoAway(away)) => return Ok(SessionEnd::of(&away)),
                        Some(body) => self.handle(body, &mut tasks)?,
                        None => {}
                    }
                }
                Some(body) = outgoing.recv() => self.send(&mut socket, body).await?,
                _ = pings.tick() => {
                    self.send(&mut socket, Body::Ping(Ping::default())).await?;
                }
                () = sleep_until(last_heard + 3 * ping) => {
                    return Err(self.lost(&format!("it was silent for {} s", 3 * ping.as_secs())));
                }
                // The reconciler runs as long as the link.
                _ = self.handled.changed() => looks.reset_immediately(),
                _ = looks.tick() => {
                    let (essence, body) = self.report();
                    let is_read = tasks.lease.has(STATUS_STREAM, Instant::now().into_std());
                    if is_read || essence != reported || Instant::now() >= report_at {
                        (reported, report_at) = (essence, Instant::now() + REPORT_MAX);
                        self.send(&mut socket, body).await?;
                    }
                }
                () = sleep_until(self.until.into()) => return Ok(SessionEnd::Changed),
                _ = settings.changed() => return Ok(SessionEnd::Changed),
            }
        }
    }

    /// Starts the tasks of a connection; also returns the frames with records.
    fn start(
        &self,
        cursors: Vec<Cursor>,
        authority: String,
    ) -> (SessionTasks, mpsc::Receiver<Body>) {
        let (core, cloud) = (self.core, self.cloud);
        let (out, outgoing) = mpsc::channel(4);
        let (uplink, received) = sync_mpsc::sync_channel(UPLINK_ORDERS);
        let cursors = cursors.into_iter().map(|cursor| (cursor.stream.clone(), cursor));
        let spools = SpoolFolders(core.layout.spool());
        let sending = Uplink::new(spools, cloud.clone(), cursors.collect(), out);
        tokio::task::spawn_blocking(move || sending.run(&received));
        let (generation, wanted) = watch::channel(0);
        let (core, folder) = (Arc::clone(core), ClipFolder(core.layout.clips()));
        let (http, tracker) = (self.http.clone(), Arc::clone(&cloud.clips));
        let mut clips = JoinSet::new();
        clips.spawn(ClipSender::new(core, folder, http, wanted, tracker).run());
        let lease = TailLease::default();
        (SessionTasks { authority, uplink, generation, lease, _clips: clips }, outgoing)
    }

    /// Hands a frame to the task that it is for. Those that a vehicle does not expect are skipped.
    fn handle(&mut self, body: Body, tasks: &mut SessionTasks) -> Result<(), Failure> {
        match body {
            Body::Desired(desired) => {
                let number = desired.generation;
                self.follow(desired, &tasks.authority)?;
                tasks.generation.send_replace(number);
            }
            Body::Ack(ack) if ack.stream.len() <= STREAM_NAME_MAX => {
                *self.has_progress = true;
                self.order(&tasks.uplink, UplinkOrder::Ack(ack))?;
            }
            Body::Tail(tail) => {
                tasks.lease = TailLease::of(tail, Instant::now().into_std());
                self.order(&tasks.uplink, UplinkOrder::Tail(tasks.lease.clone()))?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Hands a desired state to the reconciler.
    fn follow(&mut self, desired: Desired, authority: &str) -> Result<(), Failure> {
        // A number above this would lock the vehicle out of every cloud that it names later.
        if desired.generation > GENERATION_MAX {
            return Err(self.lost("the number of its desired state is above 2^60"));
        }
        if desired.deployments.len() > WANTED_MAX {
            return Err(self.lost(&format!("it wants more than {WANTED_MAX} deployments")));
        }
        let is_new = |before: &Order| before.desired.generation < desired.generation;
        *self.has_progress |= self.orders.borrow().as_ref().is_none_or(is_new);
        let (http, authority) = (self.http.clone(), authority.to_owned());
        self.orders.send_replace(Some(Order { desired, http, authority }));
        Ok(())
    }

    /// Hands a frame to the thread that sends records, unless that has ended.
    fn order(
        &self,
        orders: &sync_mpsc::SyncSender<UplinkOrder>,
        order: UplinkOrder,
    ) -> Result<(), Failure> {
        match orders.try_send(order) {
            Err(sync_mpsc::TrySendError::Full(_)) => {
                Err(self.lost("it sends more acknowledgements than there are batches"))
            }
            Ok(()) | Err(sync_mpsc::TrySendError::Disconnected(_)) => Ok(()),
        }
    }

    async fn open(&self) -> Result<Socket, Failure> {
        let stream = self.http.connect(self.dialing).await?;
        let request = format!("wss://{}/v1/link", self.http.address);
        let request = request.into_client_request().map_err(|error| self.broken(&error))?;
        let config = WebSocketConfig::default()
            .read_buffer_size(4096)
            .write_buffer_size(0)
            .max_message_size(Some(FRAME_MAX))
            .max_frame_size(Some(FRAME_MAX));
        let upgraded = tokio_tungstenite::client_async_with_config(request, stream, Some(config));
        let upgraded = timeout(PATIENCE, upgraded).await.map_err(|late| self.broken(&late))?;
        upgraded.map(|(socket, _)| socket).map_err(|error| match &error {
            tokio_tungstenite::tungstenite::Error::Http(answer)
                if matches!(answer.status().as_u16(), 401 | 403) =>
            {
                let message = format!("the cloud at {} refuses this vehicle", self.http.address);
                Failure::new(Exit::Denied, message)
                    .with_help("it may have been revoked there: enrol it again")
            }
            _ => self.broken(&error),
        })
    }

    /// Returns the answer to the first frame.
    async fn first(&self, socket: &mut Socket, authority: &str) -> Result<Option<Body>, Failure> {
        let hello = Hello {
            protocol: PROTOCOL,
            version: gleaner_base::version().to_owned(),
            key: self.core.key.to_string(),
            followed: self.core.followed(authority),
            boot: BootId::current().map(|boot| hex(&boot.0)).unwrap_or_default(),
        };
        self.send(socket, Body::Hello(hello)).await?;
        let first = timeout(PATIENCE, socket.next()).await.map_err(|late| self.broken(&late))?;
        self.frame(first)
    }

    /// Returns the content of a received frame; `None` of one that is of a later version.
    fn frame(
        &self,
        message: Option<Result<Message, tokio_tungstenite::tungstenite::Error>>,
    ) -> Result<Option<Body>, Failure> {
        match message {
            None | Some(Ok(Message::Close(_))) => Err(self.lost("it closed the connection")),
            Some(Err(error)) => Err(self.broken(&error)),
            Some(Ok(Message::Binary(bytes))) => {
                Ok(Frame::decoded(&bytes).map_err(|error| self.broken(&error))?.body)
            }
            Some(Ok(_)) => Ok(None),
        }
    }

    async fn send(&self, socket: &mut Socket, body: Body) -> Result<(), Failure> {
        let message = Message::Binary(Frame::encoded(body).into());
        let sent = timeout(PATIENCE, socket.send(message)).await;
        sent.map_err(|late| self.broken(&late))?.map_err(|error| self.broken(&error))
    }

    /// Returns the report, and what of it is worth one at once.
    fn report(&mut self) -> (String, Body) {
        let status = self.cloud.add_to(self.core.status());
        let Handled { generation, problems } = self.handled.borrow_and_update().clone();
        let all = problems.iter().take(PROBLEMS_MAX);
        let problems: Vec<_> = all.map(|it| it.bounded()).collect();
        self.cloud.lock().generation = generation;
        let deployments = status.deployments.iter().map(|it| {
            (&it.id, &it.envelope, it.is_wanted, it.runs_fallback, it.is_proven, &it.refused)
        });
        let deployments: Vec<_> = deployments.collect();
        // Those that still end, too.
        let lambdas = status.supervisor.iter().flat_map(|supervisor| &supervisor.lambdas);
        let lambdas = lambdas.map(|it| (&it.id, &it.revision, it.attempt, it.phase, it.pid));
        let lambdas: Vec<_> = lambdas.collect();
        let labels = &status.labels;
        let essence = format!("{generation} {problems:?} {labels:?} {deployments:?} {lambdas:?}");
        let status = compress(&serde_json::to_vec(&status).expect("a status is plain data"));
        (essence, Body::Reported(Reported { generation, status, problems }))
    }

    fn lost(&self, why: &str) -> Failure {
        let why = excerpt(why);
        let mut failure =
            Failure::new(Exit::Unreachable, format!("lost the cloud at {}", self.http.address));
        failure.causes = vec![why];
        failure
    }

    fn broken(&self, error: &(dyn std::error::Error + 'static)) -> Failure {
        self.http.unreachable("the connection failed", error)
    }
}
