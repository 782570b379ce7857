//! The recent samples and wakes of a recorder, and what of them was lost.

use std::collections::VecDeque;

use gleaner_messages::transport::{
    Gaps, Guid, LatchRule, LatchedSample, LatchedTopics, SampleMeta,
};

use super::clips::OpenClip;
use super::sources::RecordedSources;
use crate::RecordError;
use crate::preroll::{EntryMeta, Losses, Preroll};
use crate::window::{Group, Window};

/// Most times without an ingress that are kept, for clips that cover them.
const OUTAGES: usize = 64;

/// Most writers of a topic that are followed over a time without an ingress.
const WRITERS: usize = 256;

/// The preroll, with the losses of each source. Time never goes back.
pub struct History {
    pub preroll: Preroll,
    /// The longest message that any clip can hold.
    message_bytes: usize,
    /// By topic.
    topics: Vec<TopicLosses>,
    latched: LatchedTopics,
    /// Losses of wakes, by lambda.
    wakes: Vec<Losses>,
    /// The first stamp or time.
    began_at: i64,
    now: Option<i64>,
    /// Samples evicted before they were old enough.
    evicted_early: u64,
    too_big: u64,
    /// Times without an ingress: begin and end, which is unknown while one lasts.
    outages: VecDeque<(i64, Option<i64>)>,
    /// Time at which the last of them was noticed. Samples of the earlier ingress have earlier
    /// stamps.
    noticed_at: i64,
}

#[derive(Default)]
struct TopicLosses {
    losses: Losses,
    /// Losses upstream, from gaps in sequence numbers.
    gaps: Gaps,
    /// Each writer, with the stamp of its first sample after the last outage: its loss in the
    /// outage is known from that one.
    writers: Vec<(Guid, Option<i64>)>,
}

impl History {
    pub fn new(preroll: Preroll, message_bytes: usize) -> History {
        History {
            preroll,
            message_bytes,
            topics: Vec::new(),
            latched: LatchedTopics::default(),
            wakes: Vec::new(),
            began_at: 0,
            now: None,
            evicted_early: 0,
            too_big: 0,
            outages: VecDeque::new(),
            noticed_at: i64::MIN,
        }
    }

    pub fn now(&self) -> Option<i64> {
        self.now
    }

    /// Samples evicted early, and samples that did not fit.
    pub fn counts(&self) -> (u64, u64) {
        (self.evicted_early, self.too_big)
    }

    #[cfg(test)]
    pub fn set_message_bytes(&mut self, most: usize) {
        self.message_bytes = most;
    }

    pub fn grow(&mut self, topics: usize, lambdas: usize) {
        self.topics.resize_with(self.topics.len().max(topics), TopicLosses::default);
        self.wakes.resize_with(self.wakes.len().max(lambdas), Losses::default);
    }

    pub fn pass(&mut self, now: i64) {
        if self.now.is_none() {
            self.began_at = now;
        }
        self.now = self.now.max(Some(now));
    }

    pub fn keep(&mut self, held: EntryMeta, bytes: &[u8]) -> Result<(), RecordError> {
        let is_sample = held.source.as_topic().is_some();
        let History { preroll, topics, wakes, evicted_early, .. } = self;
        let mut gone = |gone: &EntryMeta| {
            *evicted_early += u64::from(gone.source.as_topic().is_some());
            if let Some(losses) = losses_of(topics, wakes, gone) {
                losses.overwritten.add(gone.at_ns, gone.group);
            }
        };
        // A message that is too large for any clip is not kept.
        let fits = !is_sample || bytes.len() <= self.message_bytes;
        if fits && preroll.push(held, bytes, &mut gone)? {
            return Ok(());
        }
        self.too_big += u64::from(is_sample);
        if let Some(losses) = losses_of(topics, wakes, &held) {
            losses.too_big.add(held.at_ns, held.group);
        }
        Ok(())
    }

    pub fn trim(&mut self, before: i64) -> Result<(), RecordError> {
        let History { preroll, topics, wakes, .. } = self;
        preroll.trim(before, &mut |held| {
            if let Some(losses) = losses_of(topics, wakes, held) {
                losses.aged.add(held.at_ns, held.group);
            }
        })
    }

    /// Counts losses before a sample, from its sequence number.
    pub fn note_gap(&mut self, topic: usize, meta: &SampleMeta) {
        let TopicLosses { losses, gaps, writers, .. } = &mut self.topics[topic];
        let first = (meta.at_ns > self.noticed_at).then_some(meta.at_ns);
        match writers.iter_mut().find(|(writer, _)| *writer == meta.writer) {
            Some((_, known)) => *known = (*known).or(first),
            None => {
                if writers.len() == WRITERS {
                    writers.remove(0);
                }
                writers.push((meta.writer, first));
            }
        }
        let before = gaps.lost();
        let missing = gaps.note(meta.writer, meta.seq);
        if missing > 0 {
            losses.lost.add_some(meta.at_ns, 0, missing);
        } else if gaps.lost() < before {
            losses.lost.take_back();
        }
    }

    /// Keeps a sample of a latched topic, as long as it stays valid and there is room.
    pub fn latch(&mut self, topic: usize, sample: LatchedSample, rule: LatchRule, horizon: i64) {
        self.latched.keep(topic, sample, rule, horizon);
    }

    /// Gives a clip the samples from before its begin that were still valid then.
    pub fn begin_latched(
        &self,
        clip: &mut OpenClip,
        group: &Group,
        sources: &RecordedSources,
    ) -> Result<(), RecordError> {
        for topic in sources.topics_of(group) {
            let from = clip.from(group);
            if sources.latch_rule(topic).is_some() && clip.takes_latched(topic, from) {
                let (samples, dropped) = self.latched.valid_at(topic, from);
                clip.tally(topic).latched_dropped = dropped;
                clip.latched(topic, samples, group, sources)?;
            }
        }
        Ok(())
    }

    /// Notes that the ingress has ended at `at_ns` or later, or that another one was joined then.
    /// `now_ns` is the current time.
    pub fn note_ingress(&mut self, at_ns: i64, now_ns: i64, is_there: bool) {
        match self.outages.back_mut() {
            Some((_, end @ None)) if is_there => *end = Some(at_ns),
            Some((_, None)) => {}
            _ if is_there => {}
            _ => {
                if self.outages.len() == OUTAGES {
                    self.outages.pop_front();
                }
                self.outages.push_back((at_ns, None));
                self.noticed_at = now_ns;
                let writers = self.topics.iter_mut().flat_map(|topic| &mut topic.writers);
                writers.for_each(|(_, first)| *first = None);
            }
        }
    }

    pub fn lost_wakes(&mut self, lambda: usize, at_ns: i64, count: u64) {
        self.wakes[lambda].lost.add_some(at_ns, 0, count);
    }

    /// Notes data that a window covers but that is no longer available.
    pub fn reach_back(&self, clip: &mut OpenClip, window: &Window, sources: &RecordedSources) {
        clip.begins_late(self.began_at.saturating_sub(window.from));
        let number = clip.group();
        for topic in sources.topics(window.lambda) {
            let losses = &self.topics[*topic].losses;
            let tally = clip.tally(*topic);
            tally.is_aged |= losses.aged.hides(window.from, number);
            if losses.overwritten.is_unknown(window.from, number) {
                tally.overwritten = None;
            }
            if losses.too_big.is_unknown(window.from, number) {
                tally.too_big = None;
            }
        }
    }

    /// Counts samples and wakes that the preroll has lost.
    pub fn count_losses(
        &mut self,
        clip: &mut OpenClip,
        group: &Group,
        sources: &RecordedSources,
        limit: i64,
    ) {
        let number = clip.group();
        for topic in sources.topics_of(group) {
            let covered = |at: i64| at <= limit && sources.covers(group, topic, at);
            let losses = &mut self.topics[topic].losses;
            let (overwritten, too_big) =
                (losses.overwritten.count(number, covered), losses.too_big.count(number, covered));
            let tally = clip.tally(topic);
            tally.overwritten = tally.overwritten.map(|count| count + overwritten);
            tally.too_big = tally.too_big.map(|count| count + too_big);
        }
        let inside = group.begin..=group.to.min(limit);
        for (lambda, losses) in self.wakes.iter_mut().enumerate() {
            let covered = |at: i64| inside.contains(&at);
            let lost =
                losses.overwritten.count(number, covered) + losses.too_big.count(number, covered);
            clip.journals().evicted(lambda, lost);
        }
    }

    /// Counts samples and wakes that did not reach the recorder.
    pub fn count_lost(
        &mut self,
        clip: &mut OpenClip,
        group: &Group,
        sources: &RecordedSources,
        limit: i64,
    ) {
        let (number, from, to) = (clip.group(), clip.from(group), group.to.min(limit));
        // What was lost in an outage is known from the next sample of each writer. It counts for
        // the clip that holds this sample; other clips do not know their part.
        let has_begun = |(begin, _): &&(i64, Option<i64>)| *begin <= to;
        let last_outage = self.outages.iter().rev().find(has_begun);
        let last_outage = last_outage.map(|(_, end)| end.unwrap_or(to));
        for topic in sources.topics_of(group) {
            let TopicLosses { losses, writers, .. } = &mut self.topics[topic];
            let lost = &mut losses.lost;
            let covered = |at: i64| at <= limit && sources.covers(group, topic, at);
            let is_settled =
                !writers.is_empty() && writers.iter().all(|(_, first)| first.is_some_and(covered));
            let is_known = !lost.is_unknown(from, number)
                && sources.found_at(topic).is_none_or(|at| at <= from)
                && last_outage.is_none_or(|end| end < from || is_settled);
            let count = lost.count(number, covered);
            clip.tally(topic).lost = is_known.then_some(count);
        }
        // A window may be planned to end later than now.
        let until = self.now.map_or(to, |now| to.min(now));
        let outages = self.outages.iter().map(|(begin, end)| {
            end.map_or(until, |end| end.min(until)).saturating_sub((*begin).max(from)).max(0)
        });
        clip.lacks_ingress(outages.fold(0, i64::saturating_add));
        let inside = group.begin..=to;
        for lambda in &group.lambdas {
            let count = self.wakes[*lambda].lost.count(number, |at| inside.contains(&at));
            clip.journals().undelivered(*lambda, count);
        }
    }
}

fn losses_of<'a>(
    topics: &'a mut [TopicLosses],
    wakes: &'a mut [Losses],
    held: &EntryMeta,
) -> Option<&'a mut Losses> {
    match held.source.lambda() {
        Some(lambda) => wakes.get_mut(lambda),
        None => topics.get_mut(held.source.as_topic()?).map(|topic| &mut topic.losses),
    }
}
