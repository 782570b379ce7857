//! A clip that is being written: its counts, and its trailer at the end.

use std::sync::Arc;

use gleaner_lambda::{Clip, Moment};
use gleaner_transport::SampleMeta;

use super::clip_name::clip_name;
use super::clip_writer::ClipCompletion;
use super::clip_writer::journal_part::JournalPart;
use super::limits::RecorderLimits;
use super::state::{ClipContext, Settled};
use crate::RecordError;
use crate::file::{CONTINUES, ClipHeader, ClipTopicCounts, ClipTrailer, names};
use crate::window::Group;

/// The counts of one topic in a clip.
#[derive(Clone, Debug)]
pub(super) struct TopicTally {
    pub(super) messages: u64,
    /// `None` if unknown.
    pub(super) overwritten: Option<u64>,
    pub(super) too_big: Option<u64>,
    /// Lost before they reached the recorder.
    pub(super) lost: Option<u64>,
    /// Those of `too_big` that no clip can hold.
    pub(super) huge: u64,
    /// True if a window reaches further back than the preroll.
    pub(super) is_aged: bool,
}

impl Default for TopicTally {
    fn default() -> TopicTally {
        TopicTally {
            messages: 0,
            overwritten: Some(0),
            too_big: Some(0),
            lost: None,
            huge: 0,
            is_aged: false,
        }
    }
}

/// The reason for the end of a clip.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum CloseReason {
    /// No window is open any more.
    Complete,
    /// It is full: the next clip continues after this instant.
    Full(i64),
    /// The drive ends at this instant.
    EndOfDrive(i64),
    /// It is ended early, at this instant, for this reason.
    Early(i64, Arc<str>),
}

/// A clip that is being written.
pub(super) struct OpenClip {
    /// The number of its group of windows. Entries in one of the group's clips are marked with it.
    pub(super) group: u64,
    /// Its own number.
    pub(super) clip: u64,
    /// True if it continues a full clip.
    pub(super) continues: bool,
    pub(super) begins_late_ns: i64,
    pub(super) triggers: u64,
    /// True if it has a topic from which its thumbnail is made.
    pub(super) has_images: bool,
    /// The part of the preroll that need not be searched again.
    pub(super) settled: Option<Settled>,
    /// Lambdas with more triggers than counted.
    pub(super) uncertain: Vec<usize>,
    /// Lambdas that ended while they recorded.
    pub(super) ended: Vec<usize>,
    limits: RecorderLimits,
    /// The trigger that names it.
    opening: Moment,
    from: i64,
    /// True if its file is begun.
    is_begun: bool,
    messages: u64,
    /// Counts of messages, by topic.
    tallies: Vec<TopicTally>,
    moments: Vec<Moment>,
    /// Parts of journals, by lambda; those without windows in the clip are dropped at its end.
    parts: Vec<JournalPart>,
    /// Approximate size of all parts.
    parts_bytes: usize,
    /// Lambdas whose part is short because there was no room for all together.
    crowded: Vec<usize>,
    /// Wakes that the preroll evicted, by lambda.
    wakes_lost: Vec<u64>,
    /// Wakes that did not reach the recorder, by lambda.
    wakes_undelivered: Vec<u64>,
}

impl OpenClip {
    /// An empty clip of `group`.
    pub(super) fn new(
        number: u64,
        opening: Moment,
        group: &Group,
        context: &mut ClipContext,
    ) -> OpenClip {
        OpenClip {
            group: number,
            clip: context.next_clip(),
            continues: false,
            begins_late_ns: 0,
            triggers: 0,
            has_images: false,
            settled: None,
            uncertain: Vec::new(),
            ended: Vec::new(),
            limits: context.limits,
            opening,
            from: group.from,
            is_begun: false,
            messages: 0,
            tallies: Vec::new(),
            moments: Vec::new(),
            parts: Vec::new(),
            parts_bytes: 0,
            crowded: Vec::new(),
            wakes_lost: Vec::new(),
            wakes_undelivered: Vec::new(),
        }
    }

    /// The clip that continues this one.
    pub(super) fn next(&self, group: &Group, context: &mut ClipContext) -> OpenClip {
        OpenClip {
            continues: true,
            ..OpenClip::new(self.group, self.opening.clone(), group, context)
        }
    }

    /// Its begin.
    pub(super) fn from(&self, group: &Group) -> i64 {
        self.from.min(group.from)
    }

    /// Returns whether it has no message.
    pub(super) fn is_empty(&self) -> bool {
        self.messages == 0
    }

    pub(super) fn tally(&mut self, topic: usize) -> &mut TopicTally {
        at(&mut self.tallies, topic)
    }

    /// Counts a message of this clip that no clip can hold.
    pub(super) fn refuse(&mut self, topic: usize) {
        let tally = self.tally(topic);
        tally.too_big = tally.too_big.map(|count| count + 1);
        tally.huge += 1;
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        context: &mut ClipContext,
        group: &Group,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        if let Some((clip_name, clip_header)) = self.begin(context, group) {
            context.writer.begin(self.clip, clip_name, clip_header)?;
        }
        context.writer.message(self.clip, topic, &context.topics[topic].topic, meta, cdr)?;
        self.messages += 1;
        self.tally(topic).messages += 1;
        Ok(())
    }

    /// Returns the name and header for its file, once.
    fn begin(&mut self, context: &ClipContext, group: &Group) -> Option<(String, ClipHeader)> {
        if self.is_begun {
            return None;
        }
        self.is_begun = true;
        let clip_header = ClipHeader {
            clock: context.clock.clone(),
            from_ns: self.from(group),
            lambdas: context.lambdas_of(group),
            moment: self.opening.clone(),
        };
        Some((clip_name(&self.opening.lambda, self.opening.at_ns), clip_header))
    }

    /// Keeps a wake for the lambda's journal.
    pub(super) fn wake(&mut self, lambda: usize, number: u64, encoded: &[u8]) {
        let part = at(&mut self.parts, lambda);
        let (before, cut) = (part.bytes(), part.cut());
        let others = self.parts_bytes - before;
        let left = self.limits.parts_bytes.saturating_sub(others);
        part.push(number, encoded, self.limits.part_bytes.min(left));
        self.parts_bytes = others + part.bytes();
        if left < self.limits.part_bytes && part.cut() > cut && !self.crowded.contains(&lambda) {
            self.crowded.push(lambda);
        }
    }

    /// Approximate memory for the parts of journals.
    #[cfg(test)]
    pub(super) fn journal_bytes(&self) -> usize {
        self.parts.iter().map(JournalPart::bytes).sum()
    }

    /// Counts wakes that the preroll has evicted.
    pub(super) fn lose_wakes(&mut self, lambda: usize, count: u64) {
        *at(&mut self.wakes_lost, lambda) += count;
    }

    /// Counts wakes that did not reach the recorder.
    pub(super) fn wakes_undelivered(&mut self, lambda: usize, count: u64) {
        *at(&mut self.wakes_undelivered, lambda) += count;
    }

    /// Keeps a trigger.
    pub(super) fn moment(&mut self, moment: Moment) {
        self.triggers += 1;
        if self.moments.len() < self.limits.moments {
            self.moments.push(moment);
        }
    }

    /// Completes the file; returns the clip if that is done already.
    pub(super) fn finish(
        mut self,
        context: &mut ClipContext,
        group: &Group,
        close: &CloseReason,
    ) -> Result<Option<Clip>, RecordError> {
        let topics = self.topics(context, group);
        let begin = self.begin(context, group);
        let there = topics
            .iter()
            .map(|topic| &context.topics[*topic])
            .filter(|topic_state| !topic_state.is_missing);
        let declared = there.map(|topic_state| Arc::clone(&topic_state.topic)).collect();
        let mut trailer = ClipTrailer {
            from_ns: self.from(group),
            to_ns: match close {
                CloseReason::Full(boundary) => *boundary,
                CloseReason::EndOfDrive(end) | CloseReason::Early(end, _)
                    if group.waits_for_stop() =>
                {
                    (*end).max(group.from)
                }
                CloseReason::Complete | CloseReason::EndOfDrive(_) | CloseReason::Early(..) => {
                    group.to
                }
            },
            lambdas: context.lambdas_of(group),
            triggers: self.triggers,
            ..ClipTrailer::default()
        };
        self.note_ends(group, close, &mut trailer.incomplete);
        let name = |lambda: &usize| &context.lambdas[*lambda].header.lambda;
        trailer.incomplete.extend(
            self.ended
                .iter()
                .map(|lambda| format!("{} ended before its stop trigger", name(lambda))),
        );
        trailer.incomplete.extend(self.uncertain.iter().map(|lambda| {
            let name = name(lambda);
            format!("more triggers of {name} than counted: too many waited for their clip")
        }));
        for topic in topics {
            trailer.topics.push(self.counts(context, topic, group, &mut trailer.incomplete));
        }
        let mut journals: Vec<(String, _, _)> = Vec::new();
        for lambda in &group.lambdas {
            let header = &context.lambdas[*lambda].header;
            trailer.headers.push(Arc::clone(header));
            let part = self.part(*lambda, &header.lambda, &mut trailer.incomplete);
            // A restarted lambda is another one of the same name.
            let mut names = names(&header.lambda);
            let name = names.find(|name| !journals.iter().any(|(taken, ..)| taken == name));
            journals.push((name.unwrap_or_default(), Arc::clone(header), part));
        }
        trailer.moments = self.moments;
        context.writer.finish(ClipCompletion {
            clip: self.clip,
            begin,
            trailer,
            topics: declared,
            journals,
        })
    }

    /// The topics of its lambdas, and those of which it has late messages, for a lambda whose
    /// windows ended earlier.
    fn topics(&self, context: &ClipContext, group: &Group) -> Vec<usize> {
        let mut topics = context.topics_of(group);
        let written = self
            .tallies
            .iter()
            .enumerate()
            .filter(|(_, tally)| tally.messages > 0)
            .map(|(topic, _)| topic);
        for topic in written {
            if !topics.contains(&topic) {
                topics.push(topic);
            }
        }
        topics
    }

    /// Notes why the clip does not begin and end with its windows.
    fn note_ends(&self, group: &Group, close: &CloseReason, short: &mut Vec<String>) {
        if self.continues {
            short.push(CONTINUES.to_owned());
        }
        if self.begins_late_ns > 0 {
            let late = seconds(self.begins_late_ns);
            short.push(format!("the preroll begins {late} late: nothing was recorded before"));
        }
        match close {
            CloseReason::Full(_) => {
                short.push("continues in the next clip, if there was more".to_owned())
            }
            CloseReason::EndOfDrive(_) if group.waits_for_stop() => {
                short.push("the drive ended before the lambda's stop trigger".to_owned());
            }
            CloseReason::EndOfDrive(end) if *end < group.to => {
                let early = seconds(group.to.saturating_sub(*end));
                short.push(format!("the drive ended {early} before the window did"));
            }
            CloseReason::Early(end, why) if *end < group.to => short.push(why.to_string()),
            CloseReason::EndOfDrive(_) | CloseReason::Early(..) | CloseReason::Complete => {}
        }
    }

    fn counts(
        &mut self,
        context: &ClipContext,
        topic: usize,
        group: &Group,
        short: &mut Vec<String>,
    ) -> ClipTopicCounts {
        let TopicTally { messages, overwritten, too_big, lost, huge, is_aged } =
            self.tally(topic).clone();
        let topic_state = &context.topics[topic];
        let name = &topic_state.topic.name;
        match overwritten {
            Some(0) => {}
            Some(count) => {
                let samples = plural(count, "sample");
                short.push(format!(
                    "preroll_size is too small: {samples} of {name} evicted from the preroll"
                ));
            }
            None => short.push(format!(
                "preroll_size is too small: samples of {name} evicted from the preroll, more than \
                 counted"
            )),
        }
        if huge > 0 {
            let most = self.limits.message_bytes >> 20;
            short.push(format!(
                "{} of {name} larger than {most} MiB, too large for a clip",
                plural(huge, "sample")
            ));
        }
        match too_big.map(|count| count.saturating_sub(huge)) {
            Some(0) => {}
            Some(count) => {
                short.push(format!(
                    "{} of {name} did not fit into the preroll: preroll_size",
                    plural(count, "sample")
                ));
            }
            None => {
                short.push(format!(
                    "samples of {name} did not fit into the preroll, more than counted: \
                     preroll_size"
                ));
            }
        }
        if is_aged {
            short.push(format!("a trigger came late: samples of {name} had left the preroll"));
        }
        if let Some(late) = topic_state
            .found_at
            .map(|at| at.saturating_sub(self.from(group)))
            .filter(|late| *late > 0)
        {
            short.push(format!("{name} was found {} after the clip begins", seconds(late)));
        }
        if let Some(count) = lost.filter(|count| *count > 0) {
            short.push(format!("{} of {name} did not reach the recorder", plural(count, "sample")));
        }
        let received = || Some(messages + overwritten? + too_big?);
        ClipTopicCounts {
            topic: name.clone(),
            type_name: (!topic_state.is_missing).then(|| topic_state.topic.type_name.clone()),
            received: if is_aged { None } else { received() },
            lost,
            overwritten,
            too_big,
        }
    }

    /// Takes the wakes of a lambda, and notes which are missing.
    fn part(&mut self, lambda: usize, name: &str, short: &mut Vec<String>) -> JournalPart {
        let mut part = std::mem::take(at(&mut self.parts, lambda));
        let undelivered = *at(&mut self.wakes_undelivered, lambda);
        if undelivered > 0 {
            let wakes = plural(undelivered, "wake");
            short.push(format!(
                "the journal of {name} lacks {wakes}: lost in transit to the recorder"
            ));
            let apart = part.keep_run();
            if apart > 0 {
                let wakes = plural(apart, "more wake");
                short.push(format!("the journal of {name} lacks {wakes}: some between were lost"));
            }
        }
        let lost = *at(&mut self.wakes_lost, lambda);
        if lost > 0 {
            short.push(format!(
                "the journal of {name} lacks {}: evicted from the preroll",
                plural(lost, "wake")
            ));
        }
        if part.cut() > 0 {
            let last = plural(part.cut(), "wake");
            let why = match self.crowded.contains(&lambda) {
                false => format!("longer than {} MiB", self.limits.part_bytes >> 20),
                true => format!(
                    "all journals together are longer than {} MiB",
                    self.limits.parts_bytes >> 20
                ),
            };
            short.push(format!("the journal of {name} lacks the last {last}: {why}"));
        }
        part
    }
}

/// The item at `index` of a list that grows on demand. Topics and lambdas are numbered from 0.
fn at<T: Default>(list: &mut Vec<T>, index: usize) -> &mut T {
    if list.len() <= index {
        list.resize_with(index + 1, T::default);
    }
    &mut list[index]
}

fn plural(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

fn seconds(ns: i64) -> String {
    // A time below a tenth of a second is not shown as 0.
    format!("{:.1} s", (ns as f64 / 1e9).max(0.1))
}
