//! The counts of one topic in a clip.

use super::{plural, seconds};
use crate::file::ClipTopicCounts;
use crate::recorder::sources::RecordedSources;

#[derive(Clone, Debug)]
pub struct TopicTally {
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

impl Default for TopicTally {
    fn default() -> TopicTally {
        TopicTally {
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

impl TopicTally {
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
        let TopicTally { messages, overwritten, too_big, lost, huge, is_aged, latched_dropped } =
            *self;
        let schema = sources.schema(topic);
        let name = &schema.name;
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
            let most = most >> 20;
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
        if latched_dropped > 0 {
            let samples = plural(latched_dropped, "earlier sample");
            short.push(format!("{name} is latched: {samples} of it found no room"));
        }
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
}
