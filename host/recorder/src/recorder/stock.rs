//! What is held and known while no clip is written: the preroll and its losses, topics, lambdas,
//! triggers that wait.

use std::sync::Arc;

use gleaner_journal::{Encoder, Header};
use gleaner_lambda::manifest::Record;
use gleaner_lambda::{Clip, ClipLambda, Moment};

use gleaner_transport::{Gaps, SampleMeta};

use super::draft::{Close, Draft};
use super::limits::Limits;
use super::pen::Pen;
use super::waiting::Waiting;
use crate::RecordError;
use crate::file::Topic;
use crate::preroll::{Held, Losses, Preroll, Walked};
use crate::thumbnail::is_image;
use crate::window::{Group, Window};

/// A lambda that records.
#[derive(Clone, Debug)]
pub struct Member {
    /// What it is, as its journal says it.
    pub header: Header,
    /// Its `[record]`.
    pub rules: Record,
    /// SHA-256 over the digests of its files, in hexadecimal digits.
    pub digest: String,
    /// What its clips hold, in the order of `[record]`.
    pub topics: Vec<super::TopicId>,
}

/// A topic, and who records it.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) topic: Arc<Topic>,
    pub(super) is_missing: bool,
    /// When it was found, if that was later than it was wanted.
    pub(super) found_at: Option<i64>,
    pub(super) lambdas: Vec<usize>,
    /// What numbers tell of losses.
    pub(super) gaps: Gaps,
}

impl Lane {
    pub(super) fn is_image(&self) -> bool {
        !self.is_missing && is_image(&self.topic.type_name)
    }
}

/// One lambda, its windows aside.
pub(super) struct Crew {
    /// Clips share it.
    pub(super) header: Arc<Header>,
    /// As in [`Member`].
    pub(super) digest: String,
    pub(super) topics: Vec<super::TopicId>,
    pub(super) encoder: Encoder,
    pub(super) wakes: u64,
}

/// What every clip is written with.
pub(super) struct Desk {
    pub(super) pen: Pen,
    /// Clips so far; each has its number.
    pub(super) clips: u64,
    pub(super) clock: String,
    pub(super) limits: Limits,
    /// Whether samples come as they are made, so that gaps in their numbers are losses.
    pub(super) is_live: bool,
    pub(super) lanes: Vec<Lane>,
    pub(super) crews: Vec<Crew>,
}

impl Desk {
    /// The number of a new clip.
    pub(super) fn next_clip(&mut self) -> u64 {
        self.clips += 1;
        self.clips
    }

    /// Whether a window of a lambda that records this topic contains `at`.
    pub(super) fn covers(&self, group: &Group, topic: usize, at: i64) -> bool {
        self.lanes[topic].lambdas.iter().any(|lambda| group.covers(*lambda, at))
    }

    /// The topics of the lambdas of a clip, each once, in their order.
    pub(super) fn topics_of(&self, group: &Group) -> Vec<usize> {
        let mut topics = Vec::new();
        for topic in group.lambdas.iter().flat_map(|lambda| &self.crews[*lambda].topics) {
            if !topics.contains(&topic.0) {
                topics.push(topic.0);
            }
        }
        topics
    }

    /// The lambdas of a clip.
    pub(super) fn lambdas_of(&self, group: &Group) -> Vec<ClipLambda> {
        let lambda = |lambda: &usize| {
            let Crew { header, digest, .. } = &self.crews[*lambda];
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

/// How far a clip has been settled: what came up to an entry will not be wanted by windows that
/// cover nothing new before its newest stamp. So a lambda that triggers in every wake does not have
/// the whole preroll looked through each time.
#[derive(Copy, Clone, Debug)]
pub(super) struct Settled {
    pub(super) last: Walked,
    pub(super) newest: i64,
}

/// Everything that clips are made from.
pub(super) struct Stock {
    pub(super) preroll: Preroll,
    /// By topic.
    pub(super) losses: Vec<Losses>,
    /// By lambda.
    pub(super) wake_losses: Vec<Losses>,
    pub(super) waiting: Waiting,
    pub(super) desk: Desk,
    /// When the recorder first heard of anything.
    pub(super) began_at: i64,
}

impl Stock {
    /// Keeps an entry. `evicted_early` counts samples that have to go for it, `too_big` is raised if
    /// it cannot be kept.
    pub(super) fn keep(
        &mut self,
        held: Held,
        bytes: &[u8],
        evicted_early: &mut u64,
        too_big: &mut u64,
    ) -> Result<(), RecordError> {
        let is_sample = held.source.as_topic().is_some();
        let Stock { preroll, losses, wake_losses, desk, .. } = self;
        let mut gone = |gone: &Held| {
            *evicted_early += u64::from(gone.source.as_topic().is_some());
            if let Some(losses) = losses_of(losses, wake_losses, gone) {
                losses.overwritten.add(gone.at_ns, gone.group);
            }
        };
        // What no clip can hold need not wait for one.
        let fits = !is_sample || bytes.len() <= desk.limits.message_bytes;
        if fits && preroll.push(held, bytes, &mut gone)? {
            return Ok(());
        }
        *too_big += u64::from(is_sample);
        if let Some(losses) = losses_of(losses, wake_losses, &held) {
            losses.too_big.add(held.at_ns, held.group);
        }
        Ok(())
    }

    /// Counts what the number of a sample tells of samples before it.
    pub(super) fn note_gap(&mut self, topic: usize, meta: &SampleMeta) {
        let gaps = &mut self.desk.lanes[topic].gaps;
        let before = gaps.lost();
        let missing = gaps.note(meta.writer, meta.seq);
        let lost = &mut self.losses[topic].lost;
        if missing > 0 {
            lost.add_some(meta.at_ns, 0, missing);
        } else if gaps.lost() < before {
            lost.take_back();
        }
    }

    /// Gives up what is older than `before`.
    pub(super) fn trim(&mut self, before: i64) -> Result<(), RecordError> {
        let Stock { preroll, losses, wake_losses, .. } = self;
        preroll.trim(before, &mut |held| {
            if let Some(losses) = losses_of(losses, wake_losses, held) {
                losses.aged.add(held.at_ns, held.group);
            }
        })
    }

    /// Whether an entry belongs into a clip that ends at `limit` at the latest, and is not in it.
    pub(super) fn wants(&self, draft: &Draft, group: &Group, held: &Held, limit: i64) -> bool {
        if held.group == draft.group || held.at_ns > limit {
            return false;
        }
        match held.source.as_topic() {
            Some(topic) => self.desk.covers(group, topic, held.at_ns),
            None => (group.begin..=group.to).contains(&held.at_ns),
        }
    }

    /// The stamp of the earliest sample that is covered, but in none of the clips of the group.
    pub(super) fn earliest(&self, draft: &Draft, group: &Group) -> Option<i64> {
        let mut earliest = None;
        let mut next = self.preroll.next(None);
        while let Some(place) = next.map(Walked::place) {
            let held = self.preroll.held(place);
            if held.source.as_topic().is_some() && self.wants(draft, group, &held, i64::MAX) {
                earliest = Some(earliest.map_or(held.at_ns, |at: i64| at.min(held.at_ns)));
            }
            next = self.preroll.next(next);
        }
        earliest
    }

    /// The triggers within the clip.
    pub(super) fn gather(&mut self, draft: &mut Draft, group: &Group, limit: i64) {
        let untold = self.waiting.take(group, limit, |moment| draft.moment(moment));
        draft.triggers += untold;
    }

    /// Completes a clip, which is returned if it is written already.
    pub(super) fn finish(
        &mut self,
        mut draft: Draft,
        group: &Group,
        close: Close,
    ) -> Result<Option<Clip>, RecordError> {
        let limit = if let Close::Full(boundary) = close { boundary } else { i64::MAX };
        draft.uncertain = self.waiting.uncertain(group, limit);
        if self.desk.is_live {
            self.count_lost(&mut draft, group, limit);
        }
        draft.finish(&mut self.desk, group, &close)
    }

    /// What did not even come here.
    fn count_lost(&mut self, draft: &mut Draft, group: &Group, limit: i64) {
        let (number, from) = (draft.group, draft.from(group));
        for topic in self.desk.topics_of(group) {
            let desk = &self.desk;
            let lost = &mut self.losses[topic].lost;
            let is_known = !lost.is_unknown(from, number)
                && desk.lanes[topic].found_at.is_none_or(|at| at <= from);
            let count = lost.count(number, |at| at <= limit && desk.covers(group, topic, at));
            draft.tally(topic).lost = is_known.then_some(count);
        }
        let inside = group.begin..=group.to.min(limit);
        for lambda in &group.lambdas {
            let count = self.wake_losses[*lambda].lost.count(number, |at| inside.contains(&at));
            draft.wakes_unheard(*lambda, count);
        }
    }

    /// The trigger that names a clip.
    pub(super) fn opening(&self, group: &Group) -> Moment {
        let (lambda, at_ns) = group.first;
        self.waiting.find(lambda, at_ns).cloned().unwrap_or_else(|| Moment {
            lambda: self.desk.crews[lambda].header.lambda.clone(),
            kind: gleaner_lambda::TriggerKind::Event,
            label: String::new(),
            score: None,
            attributes: None,
            at_ns,
            source: None,
        })
    }

    /// What a window asks for and nobody can give.
    pub(super) fn reach_back(&mut self, draft: &mut Draft, window: &Window) {
        draft.begins_late_ns = draft.begins_late_ns.max(self.began_at.saturating_sub(window.from));
        let number = draft.group;
        for topic in &self.desk.crews[window.lambda].topics {
            let losses = &self.losses[topic.0];
            let tally = draft.tally(topic.0);
            tally.is_aged |= losses.aged.hides(window.from, number);
            if losses.overwritten.is_unknown(window.from, number) {
                tally.overwritten = None;
            }
            if losses.too_big.is_unknown(window.from, number) {
                tally.too_big = None;
            }
        }
    }

    pub(super) fn count_losses(&mut self, draft: &mut Draft, group: &Group, limit: i64) {
        let number = draft.group;
        for topic in self.desk.topics_of(group) {
            let desk = &self.desk;
            let covered = |at: i64| at <= limit && desk.covers(group, topic, at);
            let losses = &mut self.losses[topic];
            let (overwritten, too_big) =
                (losses.overwritten.count(number, covered), losses.too_big.count(number, covered));
            let tally = draft.tally(topic);
            tally.overwritten = tally.overwritten.map(|count| count + overwritten);
            tally.too_big = tally.too_big.map(|count| count + too_big);
        }
        let inside = group.begin..=group.to.min(limit);
        for (lambda, losses) in self.wake_losses.iter_mut().enumerate() {
            let covered = |at: i64| inside.contains(&at);
            let lost =
                losses.overwritten.count(number, covered) + losses.too_big.count(number, covered);
            draft.lose_wakes(lambda, lost);
        }
    }
}

fn losses_of<'a>(
    topics: &'a mut [Losses],
    wakes: &'a mut [Losses],
    held: &Held,
) -> Option<&'a mut Losses> {
    match held.source.lambda() {
        Some(lambda) => wakes.get_mut(lambda),
        None => topics.get_mut(held.source.as_topic()?),
    }
}
