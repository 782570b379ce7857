//! A clip that is being written: its writer, its counts, and its trailer at the end.

mod journals;
mod name;
mod tally;

use std::sync::Arc;

use gleaner_lambda::{Clip, Moment};
use gleaner_messages::transport::{LatchedSample, SampleMeta};

use self::journals::ClipJournals;
use self::name::clip_name;
use self::tally::RecordedTopicCounts;
use crate::RecordError;
use crate::file::{CONTINUES, ClipHeader, ClipTrailer, names};
use crate::preroll::{EntryMeta, PrerollCursor};
use crate::recorder::limits::RecorderLimits;
use crate::recorder::sources::RecordedSources;
use crate::recorder::writer::{ClipCompletion, ClipSample, ClipWriter};
use crate::window::Group;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CloseReason {
    /// No window is open any more.
    Complete,
    /// It is full: the next clip continues after this instant.
    Full(i64),
    /// The drive ends at this instant.
    EndOfDrive(i64),
    /// It is ended early, at this instant, for this reason.
    Early(i64, Arc<str>),
}

/// The extent to which a clip has been settled: entries up to `last` are not needed by windows that
/// cover nothing new before `newest`. So a lambda that triggers in every wake does not cause a
/// search of the whole preroll each time.
#[derive(Copy, Clone, Debug)]
pub struct Settled {
    pub last: PrerollCursor,
    pub newest: i64,
}

pub struct OpenClip {
    /// The number of its group of windows. Entries in one of the group's clips are marked with it.
    group: u64,
    writer: ClipWriter,
    limits: RecorderLimits,
    /// True if it continues a full clip.
    continues: bool,
    begins_late_ns: i64,
    /// Time without an ingress.
    outage_ns: i64,
    triggers: u64,
    /// True if it has a topic from which its thumbnail is made.
    has_images: bool,
    /// The part of the preroll that need not be searched again.
    settled: Option<Settled>,
    /// Lambdas that ended while they recorded.
    ended: Vec<usize>,
    /// The trigger that names it.
    opening: Moment,
    from: i64,
    is_begun: bool,
    messages: u64,
    tallies: Vec<RecordedTopicCounts>,
    moments: Vec<Moment>,
    journals: ClipJournals,
    /// Topics that it has the latched samples of, with the time at which these were valid.
    latched_topics: Vec<(usize, i64)>,
    /// Those of them that are not written yet.
    latched: Vec<(usize, LatchedSample)>,
}

impl OpenClip {
    /// An empty clip of `group`, the group with this number.
    pub fn new(
        number: u64,
        opening: Moment,
        group: &Group,
        writer: ClipWriter,
        limits: RecorderLimits,
    ) -> OpenClip {
        OpenClip {
            group: number,
            writer,
            limits,
            continues: false,
            begins_late_ns: 0,
            outage_ns: 0,
            triggers: 0,
            has_images: false,
            settled: None,
            ended: Vec::new(),
            opening,
            from: group.from,
            is_begun: false,
            messages: 0,
            tallies: Vec::new(),
            moments: Vec::new(),
            journals: ClipJournals::new(limits),
            latched_topics: Vec::new(),
            latched: Vec::new(),
        }
    }

    /// The clip that continues this one.
    pub fn next(&self, group: &Group, writer: ClipWriter) -> OpenClip {
        OpenClip {
            continues: true,
            ..OpenClip::new(self.group, self.opening.clone(), group, writer, self.limits)
        }
    }

    pub fn group(&self) -> u64 {
        self.group
    }

    pub fn from(&self, group: &Group) -> i64 {
        self.from.min(group.from)
    }

    /// Returns whether it has no message.
    pub fn is_empty(&self) -> bool {
        self.messages == 0
    }

    /// Returns whether it has no message and no trigger.
    pub fn has_nothing(&self) -> bool {
        self.is_empty() && self.triggers == 0
    }

    /// Returns whether it has nothing, although the previous clip announced a continuation.
    pub fn is_pointless(&self) -> bool {
        self.continues && self.has_nothing()
    }

    pub fn tally(&mut self, topic: usize) -> &mut RecordedTopicCounts {
        at(&mut self.tallies, topic)
    }

    pub fn journals(&mut self) -> &mut ClipJournals {
        &mut self.journals
    }

    pub fn lacks_ingress(&mut self, outage_ns: i64) {
        self.outage_ns = outage_ns;
    }

    /// Notes that nothing was recorded in the first `late_ns` of a window.
    pub fn begins_late(&mut self, late_ns: i64) {
        self.begins_late_ns = self.begins_late_ns.max(late_ns);
    }

    /// Notes that a lambda ended before its stop trigger.
    pub fn lambda_ended(&mut self, lambda: usize) {
        if !self.ended.contains(&lambda) {
            self.ended.push(lambda);
        }
    }

    pub fn moment(&mut self, moment: Moment) {
        self.triggers += 1;
        if self.moments.len() < self.limits.moments {
            self.moments.push(moment);
        }
    }

    /// Counts triggers that were not kept.
    pub fn count_triggers(&mut self, count: u64) {
        self.triggers += count;
    }

    /// Returns whether an entry belongs into the clip, if it ends at `limit` at the latest, and is
    /// not in it yet.
    pub fn lacks(
        &self,
        held: &EntryMeta,
        group: &Group,
        limit: i64,
        sources: &RecordedSources,
    ) -> bool {
        if held.group == self.group || held.at_ns > limit {
            return false;
        }
        match held.source.as_topic() {
            Some(topic) => sources.covers(group, topic, held.at_ns),
            None => (group.begin..=group.to).contains(&held.at_ns),
        }
    }

    /// Returns the last entry that need not be searched again, if nothing is needed before
    /// `fresh_from`.
    pub fn settled_before(&mut self, fresh_from: i64) -> Option<PrerollCursor> {
        self.settled = self.settled.filter(|settled| settled.newest < fresh_from);
        self.settled.map(|settled| settled.last)
    }

    /// Notes that entries up to `last`, with the stamp `at_ns`, need not be searched again.
    pub fn settle(&mut self, last: PrerollCursor, at_ns: i64) {
        let newest = self.settled.map_or(at_ns, |settled| settled.newest.max(at_ns));
        self.settled = Some(Settled { last, newest });
    }

    /// Forgets what is settled, as the preroll has moved.
    pub fn unsettle(&mut self) {
        self.settled = None;
    }

    #[cfg(test)]
    pub fn settled(&self) -> Option<Settled> {
        self.settled
    }

    /// Chooses the topic of the thumbnail when the clip first has one with images. Returns it if
    /// its newest image before the trigger is to be searched: a clip that continues another takes
    /// its own first image.
    pub fn choose_thumbnail(
        &mut self,
        group: &Group,
        sources: &RecordedSources,
    ) -> Result<Option<usize>, RecordError> {
        if self.has_images {
            return Ok(None);
        }
        let Some(topic) = sources.first_with_images(sources.topics_of(group)) else {
            return Ok(None);
        };
        self.has_images = true;
        self.writer.thumbnail_of(topic)?;
        Ok((!self.continues).then_some(topic))
    }

    /// Makes the thumbnail preferably from this image.
    pub fn thumbnail(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        sources: &RecordedSources,
    ) -> Result<(), RecordError> {
        let schema = sources.schema(topic);
        self.writer.thumbnail(ClipSample { topic, schema, meta, cdr })
    }

    pub fn write(
        &mut self,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
        group: &Group,
        sources: &RecordedSources,
    ) -> Result<(), RecordError> {
        self.begin(group, sources)?;
        self.writer.write(ClipSample { topic, schema: sources.schema(topic), meta, cdr })?;
        self.messages += 1;
        self.tally(topic).messages += 1;
        Ok(())
    }

    /// Returns whether it has no latched samples of a topic that were valid at `from`; asked once.
    /// If it began later so far, those of that time are not written, or stay.
    pub fn takes_latched(&mut self, topic: usize, from: i64) -> bool {
        match self.latched_topics.iter_mut().find(|(known, _)| *known == topic) {
            Some((_, at)) if *at <= from => return false,
            Some((_, at)) => *at = from,
            None => self.latched_topics.push((topic, from)),
        }
        self.latched.retain(|(pending, _)| *pending != topic);
        true
    }

    /// Takes samples from before its begin. Alone, they are no reason for a clip.
    pub fn latched(
        &mut self,
        topic: usize,
        samples: Vec<LatchedSample>,
        group: &Group,
        sources: &RecordedSources,
    ) -> Result<(), RecordError> {
        self.latched.extend(samples.into_iter().map(|sample| (topic, sample)));
        if self.is_begun { self.write_latched(group, sources) } else { Ok(()) }
    }

    /// Writes latched samples with the time of its begin; their publish times stay.
    fn write_latched(
        &mut self,
        group: &Group,
        sources: &RecordedSources,
    ) -> Result<(), RecordError> {
        let at_ns = self.from(group);
        for (topic, LatchedSample { meta, cdr }) in std::mem::take(&mut self.latched) {
            let meta = SampleMeta { at_ns, is_latched: true, ..meta };
            let schema = sources.schema(topic);
            self.writer.write(ClipSample { topic, schema, meta: &meta, cdr: &cdr })?;
            self.tally(topic).messages += 1;
        }
        Ok(())
    }

    /// Sends messages that its writer has collected.
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.writer.flush()
    }

    /// Creates its file, once.
    fn begin(&mut self, group: &Group, sources: &RecordedSources) -> Result<(), RecordError> {
        if std::mem::replace(&mut self.is_begun, true) {
            return Ok(());
        }
        let header = ClipHeader {
            clock: sources.clock.to_owned(),
            from_ns: self.from(group),
            lambdas: sources.lambdas_of(group),
            moment: self.opening.clone(),
        };
        self.writer.begin(clip_name(&self.opening.lambda, self.opening.at_ns), header)?;
        self.write_latched(group, sources)
    }

    /// Completes the file; returns the clip if that is done already. `uncertain` are lambdas with
    /// more triggers than counted.
    pub fn finish(
        mut self,
        group: &Group,
        close: &CloseReason,
        uncertain: &[usize],
        sources: &RecordedSources,
    ) -> Result<Option<Clip>, RecordError> {
        let topics = self.topics(group, sources);
        self.begin(group, sources)?;
        let declared = topics
            .iter()
            .filter(|topic| !sources.is_missing(**topic))
            .map(|topic| Arc::clone(sources.schema(*topic)))
            .collect();
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
            lambdas: sources.lambdas_of(group),
            triggers: self.triggers,
            ..ClipTrailer::default()
        };
        self.note_ends(group, close, &mut trailer.incomplete);
        trailer.incomplete.extend(
            self.ended
                .iter()
                .map(|lambda| format!("{} ended before its stop trigger", sources.name(*lambda))),
        );
        trailer.incomplete.extend(uncertain.iter().map(|lambda| {
            let name = sources.name(*lambda);
            format!("more triggers of {name} than counted: too many waited for their clip")
        }));
        trailer.incomplete.extend_from_slice(&sources.notes);
        let (from, most) = (self.from(group), self.limits.message_bytes);
        for topic in topics {
            let short = &mut trailer.incomplete;
            trailer.topics.push(self.tally(topic).counts(topic, sources, from, most, short));
        }
        let mut journals: Vec<(String, _, _)> = Vec::new();
        for lambda in &group.lambdas {
            let header = sources.header(*lambda);
            trailer.headers.push(Arc::clone(header));
            let part = self.journals.take(*lambda, &header.lambda, &mut trailer.incomplete);
            // A restarted lambda is another one of the same name.
            let mut names = names(&header.lambda);
            let name = names.find(|name| !journals.iter().any(|(taken, ..)| taken == name));
            journals.push((name.unwrap_or_default(), Arc::clone(header), part));
        }
        trailer.moments = self.moments;
        self.writer.finish(ClipCompletion { trailer, topics: declared, journals })
    }

    /// The topics of its lambdas, and those of which it has late messages, for a lambda whose
    /// windows ended earlier.
    fn topics(&self, group: &Group, sources: &RecordedSources) -> Vec<usize> {
        let mut topics = sources.topics_of(group);
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
        if self.outage_ns > 0 {
            let outage = seconds(self.outage_ns);
            short.push(format!("no samples for {outage}, as the ingress had ended"));
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
