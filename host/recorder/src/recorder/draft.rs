//! A clip that is being written.

use gleaner_protocol::{Clip, Moment};
use gleaner_transport::SampleMeta;

use super::limits::Limits;
use super::part::Part;
use super::picture::Picture;
use super::stem::stem;
use super::stock::{Desk, Member, Settled};
use crate::RecordError;
use crate::file::{About, Ending, TopicCounts, Unfinished};
use crate::window::Group;

/// What one topic has in a clip, and what it has not.
#[derive(Clone, Debug)]
pub(super) struct Tally {
    pub(super) messages: u64,
    /// `None` if nobody knows.
    pub(super) overwritten: Option<u64>,
    pub(super) too_big: Option<u64>,
    /// Of those that are too big, the ones that no clip can hold.
    pub(super) huge: u64,
    /// Whether a window reaches further back than anything is held.
    pub(super) is_aged: bool,
}

impl Default for Tally {
    fn default() -> Tally {
        Tally { messages: 0, overwritten: Some(0), too_big: Some(0), huge: 0, is_aged: false }
    }
}

/// How a clip comes to its end.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Close {
    /// No window is open any more.
    Complete,
    /// It is full: the next one goes on after this instant.
    Full(i64),
    /// The drive ends, at this instant.
    EndOfDrive(i64),
}

/// A clip that is being written.
pub(super) struct Draft {
    /// The group of windows that it belongs to. What is in one of its clips bears this number.
    pub(super) group: u64,
    /// Whether it goes on where another clip was full.
    pub(super) continues: bool,
    pub(super) begins_late_ns: i64,
    pub(super) triggers: u64,
    pub(super) picture: Picture,
    /// What of the preroll need not be looked through again.
    pub(super) settled: Option<Settled>,
    /// Lambdas with more triggers than were counted.
    pub(super) uncertain: Vec<usize>,
    limits: Limits,
    /// The trigger that names it.
    opening: Moment,
    from: i64,
    file: Option<Unfinished>,
    messages: u64,
    /// By topic.
    tallies: Vec<Tally>,
    moments: Vec<Moment>,
    /// By lambda; those without windows in the clip are thrown away at its end.
    parts: Vec<Part>,
    wakes_lost: Vec<u64>,
}

impl Draft {
    /// An empty clip of `group`.
    pub(super) fn new(number: u64, opening: Moment, group: &Group, limits: Limits) -> Draft {
        Draft {
            group: number,
            continues: false,
            begins_late_ns: 0,
            triggers: 0,
            picture: Picture::default(),
            settled: None,
            uncertain: Vec::new(),
            limits,
            opening,
            from: group.from,
            file: None,
            messages: 0,
            tallies: Vec::new(),
            moments: Vec::new(),
            parts: Vec::new(),
            wakes_lost: Vec::new(),
        }
    }

    /// The clip that goes on after this one.
    pub(super) fn next(&self, group: &Group) -> Draft {
        Draft { continues: true, ..Draft::new(self.group, self.opening.clone(), group, self.limits) }
    }

    /// Whether no message is in it.
    pub(super) fn is_empty(&self) -> bool {
        self.messages == 0
    }

    pub(super) fn tally(&mut self, topic: usize) -> &mut Tally {
        at(&mut self.tallies, topic)
    }

    /// Counts a message that no clip can hold, and that would be in this one.
    pub(super) fn refuse(&mut self, topic: usize) {
        let tally = self.tally(topic);
        tally.too_big = tally.too_big.map(|count| count + 1);
        tally.huge += 1;
    }

    /// Writes a message.
    pub(super) fn message(
        &mut self,
        desk: &mut Desk,
        group: &Group,
        topic: usize,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        self.picture.offer(desk, topic, meta, cdr);
        self.open(desk, group)?.message(&desk.lanes[topic].topic, meta, cdr)?;
        self.messages += 1;
        self.tally(topic).messages += 1;
        Ok(())
    }

    /// The file, which is made when it is first needed.
    fn open(&mut self, desk: &mut Desk, group: &Group) -> Result<&mut Unfinished, RecordError> {
        let file = match self.file.take() {
            Some(file) => file,
            None => {
                let about = About {
                    clock: desk.clock.clone(),
                    from_ns: self.from.min(group.from),
                    lambdas: desk.lambdas_of(group),
                    moment: self.opening.clone(),
                };
                desk.folder.begin(&stem(&self.opening.lambda, self.opening.at_ns), &about)?
            }
        };
        Ok(self.file.insert(file))
    }

    /// Keeps a wake for the lambda's journal.
    pub(super) fn wake(&mut self, lambda: usize, number: u64, encoded: &[u8]) {
        at(&mut self.parts, lambda).push(number, encoded, self.limits.part_bytes);
    }

    /// Counts wakes that the preroll does not have any more.
    pub(super) fn lose_wakes(&mut self, lambda: usize, count: u64) {
        *at(&mut self.wakes_lost, lambda) += count;
    }

    /// Keeps a trigger.
    pub(super) fn moment(&mut self, moment: Moment) {
        self.triggers += 1;
        if self.moments.len() < self.limits.moments {
            self.moments.push(moment);
        }
    }

    /// Completes the file.
    pub(super) fn finish(mut self, desk: &mut Desk, group: &Group, close: Close) -> Result<Clip, RecordError> {
        let topics = self.topics(desk, group);
        let file = self.open(desk, group)?;
        for lane in topics.iter().map(|topic| &desk.lanes[*topic]).filter(|lane| !lane.is_missing) {
            file.declare(&lane.topic)?;
        }
        let mut ending = Ending {
            from_ns: self.from.min(group.from),
            to_ns: match close {
                Close::Complete => group.to,
                Close::Full(boundary) => boundary,
                Close::EndOfDrive(end) if group.waits_for_stop() => end.max(group.from),
                Close::EndOfDrive(_) => group.to,
            },
            lambdas: desk.lambdas_of(group),
            triggers: self.triggers,
            ..Ending::default()
        };
        self.say_ends(group, close, &mut ending.short);
        for lambda in &self.uncertain {
            let name = &desk.crews[*lambda].member.header.lambda;
            ending
                .short
                .push(format!("there are more triggers of {name} than are counted: too many waited for their clip"));
        }
        for topic in topics {
            ending.topics.push(self.counts(desk, topic, &mut ending.short));
        }
        for lambda in &group.lambdas {
            let member = &desk.crews[*lambda].member;
            ending.headers.push(member.header.clone());
            if let Some(journal) = self.journal(*lambda, member, &mut ending.short) {
                ending.journals.push((member.header.lambda.clone(), journal));
            }
        }
        ending.moments = self.moments;
        ending.thumbnail = self.picture.into_jpeg();
        let file = self.file.expect("the file was opened above");
        file.finish(ending)
    }

    /// The topics of its lambdas; and those of which it holds late messages, for a lambda whose windows ended before it.
    fn topics(&self, desk: &Desk, group: &Group) -> Vec<usize> {
        let mut topics = desk.topics_of(group);
        let written = self.tallies.iter().enumerate().filter(|(_, tally)| tally.messages > 0).map(|(topic, _)| topic);
        for topic in written {
            if !topics.contains(&topic) {
                topics.push(topic);
            }
        }
        topics
    }

    /// Why the clip does not begin and end where its windows do.
    fn say_ends(&self, group: &Group, close: Close, short: &mut Vec<String>) {
        if self.continues {
            short.push("continues the clip before".to_owned());
        }
        if self.begins_late_ns > 0 {
            let late = seconds(self.begins_late_ns);
            short.push(format!("the preroll begins {late} late: nothing was recorded before"));
        }
        match close {
            Close::Full(_) => short.push("continues in the next clip, if anything more came".to_owned()),
            Close::EndOfDrive(_) if group.waits_for_stop() => {
                short.push("the drive ended before the lambda said stop".to_owned());
            }
            Close::EndOfDrive(end) if end < group.to => {
                let early = seconds(group.to.saturating_sub(end));
                short.push(format!("the drive ended {early} before the window did"));
            }
            Close::EndOfDrive(_) | Close::Complete => {}
        }
    }

    fn counts(&mut self, desk: &Desk, topic: usize, short: &mut Vec<String>) -> TopicCounts {
        let Tally { messages, overwritten, too_big, huge, is_aged } = self.tally(topic).clone();
        let lane = &desk.lanes[topic];
        let name = &lane.topic.name;
        match overwritten {
            Some(0) => {}
            Some(count) => {
                let samples = plural(count, "sample");
                short.push(format!("the preroll was cut by preroll_size: {samples} of {name} pushed out"));
            }
            None => short.push(format!(
                "the preroll was cut by preroll_size: samples of {name} pushed out, more than were counted"
            )),
        }
        if huge > 0 {
            let most = self.limits.message_bytes >> 20;
            short.push(format!("{} of {name} larger than {most} MiB: no clip holds such", plural(huge, "sample")));
        }
        match too_big.map(|count| count.saturating_sub(huge)) {
            Some(0) => {}
            Some(count) => {
                short.push(format!("{} of {name} did not fit into the preroll: preroll_size", plural(count, "sample")));
            }
            None => {
                short.push(format!(
                    "samples of {name} did not fit into the preroll, more than were counted: preroll_size"
                ));
            }
        }
        if is_aged {
            short.push(format!("a trigger came late: samples of {name} had left the preroll"));
        }
        let received = || Some(messages + overwritten? + too_big?);
        TopicCounts {
            topic: name.clone(),
            type_name: (!lane.is_missing).then(|| lane.topic.type_name.clone()),
            received: if is_aged { None } else { received() },
            lost: None,
            overwritten,
            too_big,
        }
    }

    fn journal(&mut self, lambda: usize, member: &Member, short: &mut Vec<String>) -> Option<Vec<u8>> {
        let name = &member.header.lambda;
        let part = std::mem::take(at(&mut self.parts, lambda));
        let lost = *at(&mut self.wakes_lost, lambda);
        if lost > 0 {
            short.push(format!("the journal of {name} lacks {}: pushed out of the preroll", plural(lost, "wake")));
        }
        if part.cut() > 0 {
            let most = self.limits.part_bytes >> 20;
            let last = plural(part.cut(), "wake");
            short.push(format!("the journal of {name} lacks the last {last}: longer than {most} MiB"));
        }
        match part.write(&member.header)? {
            Ok(journal) => Some(journal),
            Err(error) => {
                tracing::error!(lambda = %name, %error, "the journal of a clip cannot be written");
                short.push(format!("the journal of {name} could not be written: {error}"));
                None
            }
        }
    }
}

/// The item at `index` of a list that grows as far as it is asked for. Topics and lambdas are numbered from 0.
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
    // What is shorter than a tenth of a second is not shown as none.
    format!("{:.1} s", (ns as f64 / 1e9).max(0.1))
}
