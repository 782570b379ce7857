//! Who is heard, and how much each may ask for.

use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Instant;

use gleaner_journal::JournalEntry;
use gleaner_lambda::manifest::RecordSpec;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::LambdaReplies;
use gleaner_vitals::IntervalDurations;
use tracing::warn;

use super::connections::LambdaEvent;
use super::rate_limit::RateLimit;
use crate::{LambdaId, LambdaSpec, RecordError, Recorder, TopicId, lambda_digest};

/// What of one lambda is heard before it is the next one's turn.
const MOST_PER_TURN: usize = 16;

/// Triggers per second that a lambda may cause, and at once.
const TRIGGERS: RateLimit = RateLimit::of(200.0, 1000.0);
/// Bytes of wakes per second that a lambda may fill the preroll with, and at once.
const BYTES: RateLimit = RateLimit::of(1048576.0, 4194304.0);

/// How far a wake's stamp may lie behind the clock, and ahead of it: it is the stamp of a sample or
/// of a tick.
const BEHIND_NS: i64 = 60_000_000_000;
const AHEAD_NS: i64 = 1_000_000_000;

/// A lambda that is heard, or will be.
pub(super) struct ConnectedLambda {
    pub(super) name: String,
    rules: RecordSpec,
    topics: Vec<TopicId>,
    inbox: Receiver<LambdaEvent>,
    replies: LambdaReplies,
    /// Once it has said what it is.
    id: Option<LambdaId>,
    triggers: RateLimit,
    bytes: RateLimit,
    /// What was refused is said once.
    is_warned: bool,
}

/// What came of listening.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct PollResult {
    pub(super) is_busy: bool,
    /// It has said what it is.
    pub(super) is_new: Option<LambdaId>,
    /// It is not recorded for: that was said, to it and in the log.
    pub(super) is_refused: bool,
    /// Nothing more is heard of it.
    pub(super) is_gone: bool,
    /// Wakes that are not recorded, and triggers of such.
    pub(super) counted: RecordingCounts,
}

impl ConnectedLambda {
    pub(super) fn new(
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

    /// Hears what it has said, up to its turn.
    pub(super) fn poll(
        &mut self,
        recorder: &mut Recorder,
        now_ns: i64,
        monotonic_ns: impl Fn() -> i64,
        spreads: &mut IntervalDurations,
    ) -> Result<PollResult, RecordError> {
        let mut polled = PollResult::default();
        for _ in 0..MOST_PER_TURN {
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
                            warn!(lambda = %self.name, error, "a lambda cannot be recorded for");
                            self.replies.refused(&why.to_string());
                            (polled.is_refused, polled.is_gone) = (true, true);
                        }
                    }
                }
                LambdaEvent::Mismatch(why) => {
                    warn!(lambda = %self.name, %why, "a lambda is not what the starter said");
                    self.replies.refused(&why);
                    (polled.is_refused, polled.is_gone) = (true, true);
                }
                LambdaEvent::Wake { entry, decided_ns, missing, bytes } => {
                    let Some(id) = self.id else { continue };
                    if missing > 0 {
                        recorder.lost_wakes(id, entry.at_ns, missing.into());
                        polled.counted.wakes_lost += u64::from(missing);
                    }
                    if let Some(refused) = self.refused(&entry, bytes, now_ns) {
                        recorder.lost_wakes(id, entry.at_ns.clamp(0, now_ns.max(0)), 1);
                        polled.counted.add(&refused);
                        continue;
                    }
                    recorder.wake(id, &entry)?;
                    if !entry.triggers.is_empty() {
                        let wait_ns = monotonic_ns().saturating_sub(decided_ns);
                        spreads.add(wait_ns);
                        self.replies.opened(u64::try_from(wait_ns).unwrap_or(0));
                    }
                }
                LambdaEvent::Closed(why) => {
                    if let Some(why) = why {
                        let error = &why as &dyn std::error::Error;
                        warn!(lambda = %self.name, error, "a lambda is not heard any more");
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

    /// Counts a wake that an honest host would not send, and its triggers: a lambda cannot fill
    /// what all share.
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
                "wakes of a lambda are not recorded: too many, or of another time"
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
