//! Handles commands over a ROS 2 topic, by which users and programs request recordings.
//!
//! A command requests what a lambda could trigger, in the lambda's name. The writers of the topic
//! are unknown, so a message is read only if it is short and within the rate limit. A command can
//! cost others only disk space, within the recorder's limits, and commands beyond the rate limit.
//!
//! - `request`: parses one message.

mod request;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_lambda::TriggerKind;
use gleaner_protocol::link::CommandStatus;
use gleaner_transport::{Delivery, ReceptionStatus, SampleMeta, Sink};
use tracing::warn;

use super::rate_limit::RateLimit;
use crate::{Commanded, LambdaId, RecordError, Recorder};
pub(super) use request::MESSAGE_MAX;
use request::{CommandError, CommandRequest};

/// The type of the topic.
pub(super) const TYPE: &str = "std_msgs/msg/String";
/// Messages that are read per second, and in a burst.
const ALLOWED: RateLimit = RateLimit::of(1.0, 5.0);
/// Maximum number of messages that are queued for the loop: more than a burst.
const WAITING: usize = 8;
/// Messages that the network keeps until they are taken.
pub(super) const QUEUE: usize = 16;
/// Interval of the log line on unread messages.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of characters of a logged refusal: a message may contain any text.
const WHY_MAX: usize = 200;

/// A message to be read.
struct CommandMessage {
    meta: SampleMeta,
    cdr: Vec<u8>,
}

/// Counts of messages that are not read.
#[derive(Debug, Default)]
struct Unread {
    too_many: AtomicU64,
    too_long: AtomicU64,
}

impl Unread {
    fn counts(&self) -> (u64, u64) {
        (self.too_many.load(Ordering::Relaxed), self.too_long.load(Ordering::Relaxed))
    }
}

/// The sink of the topic.
struct CommandSink {
    allowed: Mutex<RateLimit>,
    messages: SyncSender<CommandMessage>,
    unread: Arc<Unread>,
    reader: Thread,
}

impl Sink for CommandSink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        if cdr.len() > MESSAGE_MAX {
            self.unread.too_long.fetch_add(1, Ordering::Relaxed);
            return Delivery::TooBig;
        }
        // Only the transport's thread calls this.
        let may =
            self.allowed.lock().unwrap_or_else(PoisonError::into_inner).take(1.0, Instant::now());
        if !may
            || self.messages.try_send(CommandMessage { meta: *meta, cdr: cdr.to_vec() }).is_err()
        {
            self.unread.too_many.fetch_add(1, Ordering::Relaxed);
            return Delivery::NoSlot;
        }
        self.reader.unpark();
        Delivery::Taken
    }
}

/// Executes commands.
pub(super) struct Commands {
    topic: String,
    messages: Receiver<CommandMessage>,
    unread: Arc<Unread>,
    /// The newest lambda of each name, also after its end: an operator need not wait for a lambda
    /// that is being restarted.
    lambdas: BTreeMap<String, LambdaId>,
    /// Running recordings, by lambda and label, with the lambda that each was started with, which
    /// may have ended since.
    running: BTreeMap<(String, String), LambdaId>,
    accepted: u64,
    refused: u64,
    /// The last logged counts of unread messages, and the time.
    reported: ((u64, u64), Option<Instant>),
}

impl Commands {
    /// Returns the commands over `topic`, and their sink.
    pub(super) fn new(topic: String, reader: Thread) -> (Commands, Arc<dyn Sink>) {
        let (sender, messages) = sync_channel(WAITING);
        let unread = Arc::<Unread>::default();
        let sink = CommandSink {
            allowed: Mutex::new(ALLOWED),
            messages: sender,
            unread: Arc::clone(&unread),
            reader,
        };
        let commands = Commands {
            topic,
            messages,
            unread,
            lambdas: BTreeMap::new(),
            running: BTreeMap::new(),
            accepted: 0,
            refused: 0,
            reported: ((0, 0), None),
        };
        (commands, Arc::new(sink))
    }

    /// Adds a lambda that commands may name.
    pub(super) fn add(&mut self, name: &str, lambda: LambdaId) {
        self.lambdas.insert(name.to_owned(), lambda);
    }

    /// Forgets the running recordings, as all were ended.
    pub(super) fn forget_running(&mut self) {
        self.running.clear();
    }

    /// Executes the queued commands; returns whether there were any.
    pub(super) fn handle(&mut self, recorder: &mut Recorder) -> Result<bool, RecordError> {
        let mut any = false;
        // Later messages are for the next turn.
        for _ in 0..WAITING {
            let Ok(CommandMessage { meta, cdr }) = self.messages.try_recv() else { break };
            any = true;
            let source = format!("command on {} by {}", self.topic, meta.writer);
            let refused = match CommandRequest::read(&cdr, meta.endian) {
                Ok(request) => self.execute(request, meta.at_ns, source.clone(), recorder)?,
                Err(why) => Some(why),
            };
            match refused {
                None => self.accepted += 1,
                Some(why) => {
                    self.refused += 1;
                    // Not more log lines than messages are read.
                    warn!(%source, why = describe(&why), "command refused");
                }
            }
        }
        self.report_unread();
        Ok(any)
    }

    /// Executes a command; returns the reason if it is refused.
    fn execute(
        &mut self,
        CommandRequest { lambda, trigger }: CommandRequest,
        at_ns: i64,
        source: String,
        recorder: &mut Recorder,
    ) -> Result<Option<CommandError>, RecordError> {
        let (name, mut id) = match self.addressee(lambda) {
            Ok(found) => found,
            Err(why) => return Ok(Some(why)),
        };
        let label = trigger.label.clone();
        let key = (name, label.clone());
        match (trigger.kind, self.running.get(&key)) {
            (TriggerKind::Stop, Some(started)) => id = *started,
            (TriggerKind::Stop, None) => return Ok(Some(CommandError::NotRunning { label })),
            (TriggerKind::Start, Some(_)) => return Ok(Some(CommandError::Running { label })),
            (TriggerKind::Start, None) | (TriggerKind::Event, _) => {}
        }
        Ok(match recorder.command(id, &trigger, at_ns, source)? {
            Commanded::Opened => {
                if trigger.kind == TriggerKind::Start {
                    self.running.insert(key, id);
                }
                None
            }
            Commanded::Stopped => {
                self.running.remove(&key);
                None
            }
            Commanded::Ignored => Some(match trigger.kind {
                TriggerKind::Event => CommandError::TooMuch,
                TriggerKind::Start => CommandError::Running { label },
                TriggerKind::Stop => {
                    self.running.remove(&key);
                    CommandError::NotRunning { label }
                }
            }),
            Commanded::DiskSuppressed => Some(CommandError::DiskSuppressed),
        })
    }

    fn addressee(&self, lambda: Option<String>) -> Result<(String, LambdaId), CommandError> {
        let known = self.lambdas.len();
        match lambda {
            Some(name) => match self.lambdas.get(&name) {
                Some(id) => Ok((name, *id)),
                None => Err(CommandError::NoSuchLambda { name }),
            },
            None if known > 1 => Err(CommandError::WhichLambda { known }),
            None => self
                .lambdas
                .first_key_value()
                .map(|(name, id)| (name.clone(), *id))
                .ok_or(CommandError::NoLambdas),
        }
    }

    fn report_unread(&mut self) {
        let (unread, reported) = (self.unread.counts(), self.reported);
        if unread == reported.0 || reported.1.is_some_and(|at| at.elapsed() < REPORT_INTERVAL) {
            return;
        }
        self.reported = (unread, Some(Instant::now()));
        let (too_many, too_long) = (unread.0 - reported.0.0, unread.1 - reported.0.1);
        warn!(topic = %self.topic, too_many, too_long, "commands refused unread");
    }

    /// Returns the counts of commands.
    pub(super) fn status(&self, network: Option<&ReceptionStatus>) -> CommandStatus {
        let (too_many, too_long) = self.unread.counts();
        CommandStatus {
            topic: self.topic.clone(),
            accepted: self.accepted,
            refused: self.refused + too_many + too_long,
            writers: network.and_then(|status| status.writers),
            qos_warnings: network.map(|status| status.qos_warnings.clone()).unwrap_or_default(),
        }
    }
}

/// Formats an error with its cause for a log.
fn describe(error: &CommandError) -> String {
    let cause =
        std::error::Error::source(error).map(|cause| format!(": {cause}")).unwrap_or_default();
    visible(&format!("{error}{cause}")).chars().take(WHY_MAX).collect()
}
