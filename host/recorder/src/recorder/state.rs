//! The state of a recorder besides its open clip: the preroll and its losses, topics, lambdas,
//! waiting triggers.

use std::sync::Arc;

use gleaner_journal::{Encoder, JournalHeader};
use gleaner_lambda::manifest::RecordSpec;
use gleaner_lambda::{Clip, ClipLambda, Moment};

use gleaner_transport::{Gaps, SampleMeta};

use super::clip_writer::ClipWriter;
use super::limits::RecorderLimits;
use super::open_clip::{CloseReason, OpenClip};
use super::waiting::WaitingTriggers;
use crate::RecordError;
use crate::file::TopicSchema;
use crate::preroll::{EntryMeta, Losses, Preroll, Walked};
use crate::thumbnail::is_image;
use crate::window::{Group, Window};

/// A lambda to record for.
#[derive(Clone, Debug)]
pub struct LambdaSpec {
    /// Its description, the header of its journal.
    pub header: JournalHeader,
    /// Its `[record]`.
    pub rules: RecordSpec,
    /// SHA-256 over the digests of its files, in hexadecimal digits.
    pub digest: String,
    /// The topics of its clips, in the order of `[record]`.
    pub topics: Vec<super::TopicId>,
}

/// The state of a recorded topic.
#[derive(Debug)]
pub(super) struct TopicState {
    pub(super) topic: Arc<TopicSchema>,
    pub(super) is_missing: bool,
    /// The time when it was found, if later than requested.
    pub(super) found_at: Option<i64>,
    pub(super) lambdas: Vec<usize>,
    /// Losses, from gaps in sequence numbers.
    pub(super) gaps: Gaps,
}

impl TopicState {
    pub(super) fn is_image(&self) -> bool {
        !self.is_missing && is_image(&self.topic.type_name)
    }
}

/// The state of one lambda, without its windows.
pub(super) struct RecordedLambda {
    /// Clips share it.
    pub(super) header: Arc<JournalHeader>,
    /// As in [`LambdaSpec`].
    pub(super) digest: String,
    pub(super) topics: Vec<super::TopicId>,
    pub(super) encoder: Encoder,
    pub(super) wakes: u64,
}

/// The context of all clips: writer, limits, topics and lambdas.
pub(super) struct ClipContext {
    pub(super) writer: ClipWriter,
    /// Number of clips so far.
    pub(super) clips: u64,
    pub(super) clock: String,
    pub(super) limits: RecorderLimits,
    /// True if live, so that gaps in sequence numbers are losses.
    pub(super) is_live: bool,
    pub(super) topics: Vec<TopicState>,
    pub(super) lambdas: Vec<RecordedLambda>,
}

impl ClipContext {
    /// The number of a new clip.
    pub(super) fn next_clip(&mut self) -> u64 {
        self.clips += 1;
        self.clips
    }

    /// Returns whether a window of a lambda that records this topic contains `at`.
    pub(super) fn covers(&self, group: &Group, topic: usize, at: i64) -> bool {
        self.topics[topic].lambdas.iter().any(|lambda| group.covers(*lambda, at))
    }

    /// The topics of the lambdas of a clip, each once, in their order.
    pub(super) fn topics_of(&self, group: &Group) -> Vec<usize> {
        let mut topics = Vec::new();
        for topic in group.lambdas.iter().flat_map(|lambda| &self.lambdas[*lambda].topics) {
            if !topics.contains(&topic.0) {
                topics.push(topic.0);
            }
        }
        topics
    }

    /// The lambdas of a clip.
    pub(super) fn lambdas_of(&self, group: &Group) -> Vec<ClipLambda> {
        let lambda = |lambda: &usize| {
            let RecordedLambda { header, digest, .. } = &self.lambdas[*lambda];
            ClipLambda {
                name: header.lambda.clone(),
                version: header.version.clone(),
                kind: header.kind,
                digest: digest.clone(),
                windows: group.windows(*lambda),
            }
        };
        group.lambdas.iter().map(lambda).collect()
    }
}

/// The extent to which a clip has been settled: entries up to `last` are not needed by windows that
/// cover nothing new before `newest`. So a lambda that triggers in every wake does not cause a
/// search of the whole preroll each time.
#[derive(Copy, Clone, Debug)]
pub(super) struct Settled {
    pub(super) last: Walked,
    pub(super) newest: i64,
}

/// The state that clips are made from.
pub(super) struct RecorderState {
    pub(super) preroll: Preroll,
    /// Losses of samples, by topic.
    pub(super) losses: Vec<Losses>,
    /// Losses of wakes, by lambda.
    pub(super) wake_losses: Vec<Losses>,
    pub(super) waiting: WaitingTriggers,
    pub(super) context: ClipContext,
    /// The first stamp or time of the recorder.
    pub(super) began_at: i64,
}

impl RecorderState {
    /// Adds an entry to the preroll. `evicted_early` counts samples evicted for it, `too_big` is
    /// raised if it cannot be kept.
    pub(super) fn keep(
        &mut self,
        held: EntryMeta,
        bytes: &[u8],
        evicted_early: &mut u64,
        too_big: &mut u64,
    ) -> Result<(), RecordError> {
        let is_sample = held.source.as_topic().is_some();
        let RecorderState { preroll, losses, wake_losses, context, .. } = self;
        let mut gone = |gone: &EntryMeta| {
            *evicted_early += u64::from(gone.source.as_topic().is_some());
            if let Some(losses) = losses_of(losses, wake_losses, gone) {
                losses.overwritten.add(gone.at_ns, gone.group);
            }
        };
        // A message that is too large for any clip is not kept.
        let fits = !is_sample || bytes.len() <= context.limits.message_bytes;
        if fits && preroll.push(held, bytes, &mut gone)? {
            return Ok(());
        }
        *too_big += u64::from(is_sample);
        if let Some(losses) = losses_of(losses, wake_losses, &held) {
            losses.too_big.add(held.at_ns, held.group);
        }
        Ok(())
    }

    /// Counts losses before a sample, from its sequence number.
    pub(super) fn note_gap(&mut self, topic: usize, meta: &SampleMeta) {
        let gaps = &mut self.context.topics[topic].gaps;
        let before = gaps.lost();
        let missing = gaps.note(meta.writer, meta.seq);
        let lost = &mut self.losses[topic].lost;
        if missing > 0 {
            lost.add_some(meta.at_ns, 0, missing);
        } else if gaps.lost() < before {
            lost.take_back();
        }
    }

    /// Drops entries older than `before`.
    pub(super) fn trim(&mut self, before: i64) -> Result<(), RecordError> {
        let RecorderState { preroll, losses, wake_losses, .. } = self;
        preroll.trim(before, &mut |held| {
            if let Some(losses) = losses_of(losses, wake_losses, held) {
                losses.aged.add(held.at_ns, held.group);
            }
        })
    }

    /// Returns whether an entry belongs into a clip that ends at `limit` at the latest, and is not
    /// in it yet.
    pub(super) fn wants(
        &self,
        open_clip: &OpenClip,
        group: &Group,
        held: &EntryMeta,
        limit: i64,
    ) -> bool {
        if held.group == open_clip.group || held.at_ns > limit {
            return false;
        }
        match held.source.as_topic() {
            Some(topic) => self.context.covers(group, topic, held.at_ns),
            None => (group.begin..=group.to).contains(&held.at_ns),
        }
    }

    /// The stamp of the earliest sample that is covered, but in no clip of the group.
    pub(super) fn earliest(&self, open_clip: &OpenClip, group: &Group) -> Option<i64> {
        let mut earliest = None;
        let mut next = self.preroll.next(None);
        while let Some(place) = next.map(Walked::place) {
            let held = self.preroll.held(place);
            if held.source.as_topic().is_some() && self.wants(open_clip, group, &held, i64::MAX) {
                earliest = Some(earliest.map_or(held.at_ns, |at: i64| at.min(held.at_ns)));
            }
            next = self.preroll.next(next);
        }
        earliest
    }

    /// Collects the triggers within the clip.
    pub(super) fn gather(&mut self, open_clip: &mut OpenClip, group: &Group, limit: i64) {
        let counted = self.waiting.take(group, limit, |moment| open_clip.moment(moment));
        open_clip.triggers += counted;
    }

    /// Completes a clip; returns it if it is written already.
    pub(super) fn finish(
        &mut self,
        mut open_clip: OpenClip,
        group: &Group,
        close: CloseReason,
    ) -> Result<Option<Clip>, RecordError> {
        let limit = if let CloseReason::Full(boundary) = close { boundary } else { i64::MAX };
        open_clip.uncertain = self.waiting.uncertain(group, limit);
        if self.context.is_live {
            self.count_lost(&mut open_clip, group, limit);
        }
        open_clip.finish(&mut self.context, group, &close)
    }

    /// Counts samples and wakes that did not reach the recorder.
    fn count_lost(&mut self, open_clip: &mut OpenClip, group: &Group, limit: i64) {
        let (number, from) = (open_clip.group, open_clip.from(group));
        for topic in self.context.topics_of(group) {
            let context = &self.context;
            let lost = &mut self.losses[topic].lost;
            let is_known = !lost.is_unknown(from, number)
                && context.topics[topic].found_at.is_none_or(|at| at <= from);
            let count = lost.count(number, |at| at <= limit && context.covers(group, topic, at));
            open_clip.tally(topic).lost = is_known.then_some(count);
        }
        let inside = group.begin..=group.to.min(limit);
        for lambda in &group.lambdas {
            let count = self.wake_losses[*lambda].lost.count(number, |at| inside.contains(&at));
            open_clip.wakes_undelivered(*lambda, count);
        }
    }

    /// The trigger that names a clip.
    pub(super) fn opening(&self, group: &Group) -> Moment {
        let (lambda, at_ns) = group.first;
        self.waiting.find(lambda, at_ns).cloned().unwrap_or_else(|| Moment {
            lambda: self.context.lambdas[lambda].header.lambda.clone(),
            kind: gleaner_lambda::TriggerKind::Event,
            label: String::new(),
            score: None,
            attributes: None,
            at_ns,
            source: None,
        })
    }

    /// Counts data that a window covers but that is no longer available.
    pub(super) fn reach_back(&mut self, open_clip: &mut OpenClip, window: &Window) {
        open_clip.begins_late_ns =
            open_clip.begins_late_ns.max(self.began_at.saturating_sub(window.from));
        let number = open_clip.group;
        for topic in &self.context.lambdas[window.lambda].topics {
            let losses = &self.losses[topic.0];
            let tally = open_clip.tally(topic.0);
            tally.is_aged |= losses.aged.hides(window.from, number);
            if losses.overwritten.is_unknown(window.from, number) {
                tally.overwritten = None;
            }
            if losses.too_big.is_unknown(window.from, number) {
                tally.too_big = None;
            }
        }
    }

    pub(super) fn count_losses(&mut self, open_clip: &mut OpenClip, group: &Group, limit: i64) {
        let number = open_clip.group;
        for topic in self.context.topics_of(group) {
            let context = &self.context;
            let covered = |at: i64| at <= limit && context.covers(group, topic, at);
            let losses = &mut self.losses[topic];
            let (overwritten, too_big) =
                (losses.overwritten.count(number, covered), losses.too_big.count(number, covered));
            let tally = open_clip.tally(topic);
            tally.overwritten = tally.overwritten.map(|count| count + overwritten);
            tally.too_big = tally.too_big.map(|count| count + too_big);
        }
        let inside = group.begin..=group.to.min(limit);
        for (lambda, losses) in self.wake_losses.iter_mut().enumerate() {
            let covered = |at: i64| inside.contains(&at);
            let lost =
                losses.overwritten.count(number, covered) + losses.too_big.count(number, covered);
            open_clip.lose_wakes(lambda, lost);
        }
    }
}

fn losses_of<'a>(
    topics: &'a mut [Losses],
    wakes: &'a mut [Losses],
    held: &EntryMeta,
) -> Option<&'a mut Losses> {
    match held.source.lambda() {
        Some(lambda) => wakes.get_mut(lambda),
        None => topics.get_mut(held.source.as_topic()?),
    }
}
