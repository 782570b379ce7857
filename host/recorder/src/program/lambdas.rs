//! The connected lambdas, and their rate limits.

use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Instant;

use gleaner_base::RateLimit;
use gleaner_journal::JournalEntry;
use gleaner_lambda::manifest::RecordSpec;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::LambdaReplies;
use gleaner_vitals::IntervalDurations;
use tracing::warn;

use super::connections::LambdaEvent;
use crate::{LambdaId, LambdaSpec, RecordError, Recorder, TopicId, lambda_digest};

/// Maximum number of messages of one lambda before the next one's turn.
const MESSAGES_PER_TURN: usize = 16;

/// Triggers of a lambda per second, and in a burst.
const TRIGGERS: RateLimit = RateLimit::of(200.0, 1000.0);
/// Bytes of wakes of a lambda per second, and in a burst: they take room in the preroll.
const BYTES: RateLimit = RateLimit::of(1048576.0, 4194304.0);

/// Greatest lag and lead of a wake's stamp relative to the clock: it is the stamp of a sample or of
/// a tick.
const BEHIND_NS: i64 = 60_000_000_000;
const AHEAD_NS: i64 = 1_000_000_000;

/// A lambda that is connected, or will be.
pub struct ConnectedLambda {
    name: String,
    rules: RecordSpec,
    topics: Vec<TopicId>,
    inbox: Receiver<LambdaEvent>,
    replies: LambdaReplies,
    /// Set once its header was received.
    id: Option<LambdaId>,
    triggers: RateLimit,
    bytes: RateLimit,
    /// Set once a refused wake was logged.
    is_warned: bool,
}

#[derive(Copy, Clone, Debug, Default)]
pub struct PollResult {
    /// True if there was a message.
    pub is_busy: bool,
    /// Set if its header was received and it was added.
    pub is_new: Option<LambdaId>,
    /// True if it is refused. The reason was sent to it and logged.
    pub is_refused: bool,
    pub is_gone: bool,
    /// Counts of wakes that are not recorded, and their triggers.
    pub counted: RecordingCounts,
}

impl ConnectedLambda {
    pub fn new(
        name: String,
        rules: RecordSpec,
        topics: Vec<TopicId>,
        inbox: Receiver<LambdaEvent>,
        replies: LambdaReplies,
    ) -> ConnectedLambda {
        ConnectedLambda {
            name,
            rules,
            topics,
            inbox,
            replies,
            id: None,
            triggers: TRIGGERS,
            bytes: BYTES,
            is_warned: false,
        }
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// Accepts no further messages than those that were sent.
    pub fn accept_no_more(&self) {
        self.replies.accept_no_more();
    }

    /// Handles queued messages of the lambda, at most [`MESSAGES_PER_TURN`].
    pub fn poll(
        &mut self,
        recorder: &mut Recorder,
        now_ns: i64,
        monotonic_ns: impl Fn() -> i64,
        spreads: &mut IntervalDurations,
    ) -> Result<PollResult, RecordError> {
        let mut polled = PollResult::default();
        for _ in 0..MESSAGES_PER_TURN {
            let event = match self.inbox.try_recv() {
                Ok(event) => event,
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => LambdaEvent::Closed(None),
            };
            polled.is_busy = true;
            match event {
                LambdaEvent::Hello(header) => {
                    let digest = lambda_digest(&header.files);
                    let (rules, topics) = (self.rules.clone(), self.topics.clone());
                    match recorder.try_add_lambda(LambdaSpec {
                        header: *header,
                        rules,
                        digest,
                        topics,
                    }) {
                        Ok(id) => {
                            self.id = Some(id);
                            polled.is_new = Some(id);
                            self.replies.ready();
                        }
                        Err(why) => {
                            let error = &why as &dyn std::error::Error;
                            warn!(lambda = %self.name, error, "cannot record for a lambda");
                            self.replies.refused(&why.to_string());
                            (polled.is_refused, polled.is_gone) = (true, true);
                        }
                    }
                }
                LambdaEvent::Mismatch(why) => {
                    warn!(lambda = %self.name, %why, "a lambda differs from its announcement");
                    self.replies.refused(&why);
                    (polled.is_refused, polled.is_gone) = (true, true);
                }
                LambdaEvent::Wake { entry, decided_ns, missing, encoded } => {
                    let Some(id) = self.id else { continue };
                    if missing > 0 {
                        recorder.lost_wakes(id, entry.at_ns, missing.into());
                        polled.counted.wakes_lost += u64::from(missing);
                    }
                    if let Some(refused) = self.refused(&entry, encoded.len(), now_ns) {
                        recorder.lost_wakes(id, entry.at_ns.clamp(0, now_ns.max(0)), 1);
                        polled.counted.add(&refused);
                        continue;
                    }
                    recorder.encoded_wake(id, &entry, &encoded)?;
                    if !entry.triggers.is_empty() {
                        let wait_ns = monotonic_ns().saturating_sub(decided_ns);
                        spreads.add(wait_ns);
                        self.replies.opened(u64::try_from(wait_ns).unwrap_or(0));
                    }
                }
                LambdaEvent::Engine(engine) => {
                    if let Some(id) = self.id {
                        recorder.set_engine(id, engine);
                    }
                }
                LambdaEvent::Closed(why) => {
                    if let Some(why) = why {
                        let error = &why as &dyn std::error::Error;
                        warn!(lambda = %self.name, error, "lost the connection to a lambda");
                    }
                    polled.is_gone = true;
                }
            }
            if polled.is_gone {
                self.replies.close();
                if let Some(id) = self.id {
                    recorder.end_lambda(id, now_ns)?;
                }
                break;
            }
        }
        Ok(polled)
    }

    /// Checks a wake against the rate limits and the clock; returns its counts if it is refused. A
    /// well-behaved host sends no such wakes, and a lambda must not exhaust resources that all
    /// share.
    fn refused(
        &mut self,
        entry: &JournalEntry,
        bytes: usize,
        now_ns: i64,
    ) -> Option<RecordingCounts> {
        let now = Instant::now();
        let is_now = (now_ns.saturating_sub(BEHIND_NS)..=now_ns.saturating_add(AHEAD_NS))
            .contains(&entry.at_ns);
        let triggers = entry.triggers.len() as u64;
        if is_now && self.bytes.take(bytes as f64, now) && self.triggers.take(triggers as f64, now)
        {
            return None;
        }
        if !self.is_warned {
            self.is_warned = true;
            warn!(
                lambda = %self.name,
                is_now,
                "wakes of a lambda are not recorded: over the rate limit, or misstamped"
            );
        }
        Some(match is_now {
            true => RecordingCounts {
                wakes_over_rate: 1,
                triggers_over_rate: triggers,
                ..RecordingCounts::default()
            },
            false => RecordingCounts {
                wakes_misstamped: 1,
                triggers_misstamped: triggers,
                ..RecordingCounts::default()
            },
        })
    }
}
