//! The connected lambdas, and their rate limits.

use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Instant;

use gleaner_base::RateLimit;
use gleaner_journal::{JournalEntry, JournalHeader};
use gleaner_lambda::manifest::RecordSpec;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::LambdaReplies;
use gleaner_protocol::process_stats::IntervalDurations;
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
                Err(TryRecvError::Empty) => break,
                event => event.unwrap_or(LambdaEvent::Closed(None)),
            };
            polled.is_busy = true;
            match event {
                LambdaEvent::Hello(header) => match self.hello(*header, recorder) {
                    Some(id) => polled.is_new = Some(id),
                    None => polled.is_refused = true,
                },
                LambdaEvent::Mismatch(why) => {
                    warn!(lambda = %self.name, %why, "a lambda is not the one that was announced");
                    self.replies.refused(&why);
                    polled.is_refused = true;
                }
                LambdaEvent::Wake { entry, decided_ns, missing, encoded } => {
                    let Some(id) = self.id else { continue };
                    if missing > 0 {
                        recorder.lost_wakes(id, entry.at_ns, missing.into());
                        polled.counted.wakes_lost += u64::from(missing);
                    }
                    let refused = self.wake(id, &entry, &encoded, now_ns, recorder)?;
                    polled.counted.add(&refused.unwrap_or_default());
                    if refused.is_none() && !entry.triggers.is_empty() {
                        let wait_ns = monotonic_ns().saturating_sub(decided_ns);
                        spreads.add(wait_ns);
                        self.replies.opened(u64::try_from(wait_ns).unwrap_or(0));
                    }
                }
                LambdaEvent::Engine(engine) => {
                    let Some(id) = self.id else { continue };
                    recorder.set_engine(id, engine);
                }
                LambdaEvent::Closed(why) => {
                    if let Some(why) = why {
                        let error = &why as &dyn std::error::Error;
                        warn!(lambda = %self.name, error, "lost the connection to a lambda");
                    }
                    polled.is_gone = true;
                }
            }
            polled.is_gone |= polled.is_refused;
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

    /// Adds the lambda to the recorder; `None` if it is refused.
    fn hello(&mut self, header: JournalHeader, recorder: &mut Recorder) -> Option<LambdaId> {
        let digest = lambda_digest(&header.files);
        let (rules, topics) = (self.rules.clone(), self.topics.clone());
        match recorder.try_add_lambda(LambdaSpec { header, rules, digest, topics }) {
            Ok(id) => {
                self.id = Some(id);
                self.replies.ready();
            }
            Err(why) => {
                let error = &why as &dyn std::error::Error;
                warn!(lambda = %self.name, error, "cannot record for a lambda");
                self.replies.refused(&why.to_string());
                return None;
            }
        }
        self.id
    }

    /// Records a wake; returns its counts if it is refused.
    fn wake(
        &mut self,
        id: LambdaId,
        entry: &JournalEntry,
        encoded: &[u8],
        now_ns: i64,
        recorder: &mut Recorder,
    ) -> Result<Option<RecordingCounts>, RecordError> {
        let refused = self.refused(entry, encoded.len(), now_ns);
        match refused {
            Some(_) => recorder.lost_wakes(id, entry.at_ns.clamp(0, now_ns.max(0)), 1),
            None => recorder.encoded_wake(id, entry, encoded)?,
        }
        Ok(refused)
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
                ..Default::default()
            },
            false => RecordingCounts {
                wakes_misstamped: 1,
                triggers_misstamped: triggers,
                ..Default::default()
            },
        })
    }
}
