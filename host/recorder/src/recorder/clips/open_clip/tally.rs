//! The counts of one topic in a clip.

use super::{plural, seconds};
use crate::file::ClipTopicCounts;
use crate::recorder::sources::RecordedSources;

#[derive(Clone, Debug)]
pub struct RecordedTopicCounts {
    pub messages: u64,
    /// `None` if unknown.
    pub overwritten: Option<u64>,
    pub too_big: Option<u64>,
    /// Lost before they reached the recorder.
    pub lost: Option<u64>,
    /// Those of `too_big` that no clip can hold.
    huge: u64,
    /// True if a window reaches further back than the preroll.
    pub is_aged: bool,
    pub latched_dropped: u64,
}

impl Default for RecordedTopicCounts {
    fn default() -> RecordedTopicCounts {
        RecordedTopicCounts {
            messages: 0,
            overwritten: Some(0),
            too_big: Some(0),
            lost: None,
            huge: 0,
            is_aged: false,
            latched_dropped: 0,
        }
    }
}

impl RecordedTopicCounts {
    pub fn refuse(&mut self) {
        self.too_big = self.too_big.map(|count| count + 1);
        self.huge += 1;
    }

    /// Returns the counts of a clip that begins at `from`, and notes what it lacks. `most` is the
    /// longest message of a clip.
    pub fn counts(
        &self,
        topic: usize,
        sources: &RecordedSources,
        from: i64,
        most: usize,
        short: &mut Vec<String>,
    ) -> ClipTopicCounts {
        let RecordedTopicCounts {
            messages,
            overwritten,
            too_big,
            lost,
            is_aged,
            huge: _,
            latched_dropped: _,
        } = *self;
        let schema = sources.schema(topic);
        let name = &schema.name;
        self.note_dropped(name, most, short);
        if !sources.has_seen(topic) {
            short.push(format!("no message of {name} was received before the clip ended"));
        }
        let late = sources.found_at(topic).map(|at| at.saturating_sub(from));
        if let Some(late) = late.filter(|late| *late > 0) {
            short.push(format!("{name} was found {} after the clip begins", seconds(late)));
        }
        if let Some(count) = lost.filter(|count| *count > 0) {
            short.push(format!("{} of {name} did not reach the recorder", plural(count, "sample")));
        }
        let received = || Some(messages + overwritten? + too_big?);
        ClipTopicCounts {
            topic: name.clone(),
            type_name: (!sources.is_missing(topic)).then(|| schema.type_name.clone()),
            received: if is_aged { None } else { received() },
            lost,
            overwritten,
            too_big,
        }
    }

    /// Notes the samples of the topic `name` that had no room.
    fn note_dropped(&self, name: &str, most: usize, short: &mut Vec<String>) {
        let samples = |count| plural(count, "sample");
        match self.overwritten {
            Some(0) => {}
            Some(count) => short.push(format!(
                "preroll_size is too small: {} of {name} evicted from the preroll",
                samples(count)
            )),
            None => short.push(format!(
                "preroll_size is too small: samples of {name} evicted from the preroll, more than \
                 counted"
            )),
        }
        if self.huge > 0 {
            let (samples, most) = (samples(self.huge), most >> 20);
            short.push(format!("{samples} of {name} larger than {most} MiB, too large for a clip"));
        }
        match self.too_big.map(|count| count.saturating_sub(self.huge)) {
            Some(0) => {}
            Some(count) => short.push(format!(
                "{} of {name} did not fit into the preroll: preroll_size",
                samples(count)
            )),
            None => short.push(format!(
                "samples of {name} did not fit into the preroll, more than counted: preroll_size"
            )),
        }
        if self.is_aged {
            short.push(format!("a trigger came late: samples of {name} had left the preroll"));
        }
        if self.latched_dropped > 0 {
            let samples = plural(self.latched_dropped, "earlier sample");
            short.push(format!("{name} is latched: {samples} of it found no room"));
        }
    }
}
