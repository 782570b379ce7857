//! Handles commands over a ROS 2 topic, by which users and programs request recordings.
//!
//! A command requests what a lambda could trigger, in the lambda's name. The writers of the topic
//! are unknown, so a message is read only if it is short and within the rate limit. A command can
//! cost others only disk space, within the recorder's limits, and commands beyond the rate limit.
//!
//! - `request`: parses one message.

mod request;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use gleaner_base::{RateLimit, visible};
use gleaner_lambda::TriggerKind;
use gleaner_messages::transport::{ReceptionStatus, SampleMeta};
use gleaner_protocol::link::CommandStatus;
use gleaner_samples::SharedTopicReader;
use tracing::warn;

use super::samples::SampleReader;
use crate::{Commanded, LambdaId, RecordError, Recorder};
use request::{CommandError, CommandRequest};

/// Messages that are read per second, and in a burst.
const ALLOWED: RateLimit = RateLimit::of(1.0, 5.0);
/// Maximum number of messages that are read in one turn of the loop.
const TURN: usize = 64;
/// Interval of the log line on unread messages.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of characters of a logged refusal: a message may contain any text.
const WHY_MAX: usize = 200;

pub struct Commands {
    topic: String,
    /// The topic's messages, once it is attached.
    messages: Option<SampleReader>,
    allowed: RateLimit,
    /// Messages beyond the rate limit.
    too_many: u64,
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
    pub fn new(topic: String) -> Commands {
        Commands {
            topic,
            messages: None,
            allowed: ALLOWED,
            too_many: 0,
            lambdas: BTreeMap::new(),
            running: BTreeMap::new(),
            accepted: 0,
            refused: 0,
            reported: ((0, 0), None),
        }
    }

    /// Receives the messages of the topic from now on, or again from an ingress that was restarted.
    pub fn attach(&mut self, fed: SharedTopicReader) {
        match &mut self.messages {
            Some(messages) => messages.continue_in(fed),
            None => self.messages = Some(SampleReader::new(fed)),
        }
    }

    /// Adds a lambda that commands may name.
    pub fn add(&mut self, name: &str, lambda: LambdaId) {
        self.lambdas.insert(name.to_owned(), lambda);
    }

    /// Forgets the running recordings, as all were ended.
    pub fn forget_running(&mut self) {
        self.running.clear();
    }

    /// Executes the commands that came; returns whether there were any.
    pub fn handle(&mut self, recorder: &mut Recorder) -> Result<bool, RecordError> {
        let Some(mut messages) = self.messages.take() else { return Ok(false) };
        let mut count = 0;
        // Later messages are for the next turn.
        while count < TURN && messages.look().is_some() {
            let read = |meta: &SampleMeta, cdr: &[u8]| self.message(meta, cdr, recorder);
            let (read, _) = messages.read(i64::MAX, TURN, read)?;
            count += read.max(1);
        }
        self.messages = Some(messages);
        self.report_unread();
        Ok(count > 0)
    }

    /// Executes the command of a message, within the rate limit.
    fn message(
        &mut self,
        meta: &SampleMeta,
        cdr: &[u8],
        recorder: &mut Recorder,
    ) -> Result<(), RecordError> {
        if !self.allowed.take(1.0, Instant::now()) {
            self.too_many += 1;
            return Ok(());
        }
        let source = format!("command on {} by {}", self.topic, meta.writer);
        let refused = match CommandRequest::read(cdr, meta.endian) {
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
        Ok(())
    }

    /// Numbers of messages that were not read: too many, and too long.
    fn unread(&self) -> (u64, u64) {
        let messages = self.messages.as_ref();
        let (missed, too_long) =
            messages.map_or((0, 0), |messages| (messages.missed(), messages.too_big()));
        (self.too_many + missed, too_long)
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
        let (unread, reported) = (self.unread(), self.reported);
        if unread == reported.0 || reported.1.is_some_and(|at| at.elapsed() < REPORT_INTERVAL) {
            return;
        }
        self.reported = (unread, Some(Instant::now()));
        let (too_many, too_long) = (unread.0 - reported.0.0, unread.1 - reported.0.1);
        warn!(topic = %self.topic, too_many, too_long, "dropped commands: too many, or too long");
    }

    pub fn status(&self, network: Option<&ReceptionStatus>) -> CommandStatus {
        let (too_many, too_long) = self.unread();
        CommandStatus {
            topic: self.topic.clone(),
            accepted: self.accepted,
            refused: self.refused + too_many + too_long,
            writers: network.and_then(|status| status.writers),
            qos_warnings: network.map(|status| status.qos_warnings.clone()).unwrap_or_default(),
        }
    }
}

fn describe(error: &CommandError) -> String {
    let cause =
        std::error::Error::source(error).map(|cause| format!(": {cause}")).unwrap_or_default();
    visible(&format!("{error}{cause}")).chars().take(WHY_MAX).collect()
}
