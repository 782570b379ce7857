//! What a clip tells people of itself, to be compared with what its journal says.

use std::collections::BTreeMap;

use gleaner_protocol::journal::{Difference, Entry};
use gleaner_protocol::visible;

/// What a clip tells people of itself, in its metadata.
#[derive(Default)]
pub(super) struct Told {
    /// Messages of each topic.
    pub(super) messages: Vec<(String, u64)>,
    /// What is missing of each topic, in words.
    losses: Vec<String>,
    /// Triggers of the lambda.
    pub(super) triggers: u64,
    /// The first of them, in words.
    moments: Vec<String>,
}

/// As many moments as a clip keeps.
const MOMENTS_MAX: usize = 10_000;

impl Told {
    pub(super) fn of(metadata: &[(String, BTreeMap<String, String>)], lambda: &str) -> Self {
        let mut told = Self::default();
        for (name, values) in metadata {
            let value = |key: &str| values.get(key).map_or("", String::as_str);
            match name.as_str() {
                "gleaner.topic" => {
                    told.messages.push((value("topic").to_owned(), value("messages").parse().unwrap_or(0)));
                    for (key, what) in [("overwritten", "pushed out"), ("too_big", "too big")] {
                        if value(key) != "0" {
                            told.losses.push(format!("{}: {} {what}", value("topic"), value(key)));
                        }
                    }
                }
                // A command is no trigger of the lambda: its journal does not have it.
                "gleaner.decision" if value("lambda") == lambda && !values.contains_key("source") => {
                    let score = values.get("score").map_or("none", String::as_str);
                    told.moments.push(moment(value("at_ns"), value("kind"), value("label"), score));
                }
                _ => {}
            }
        }
        told
    }

    /// Adds what the journal says.
    pub(super) fn add(&mut self, entry: &Entry) {
        for trigger in &entry.triggers {
            self.triggers += 1;
            if self.moments.len() < MOMENTS_MAX {
                let score = trigger.score.map_or("none".to_owned(), |score| score.to_string());
                self.moments.push(moment(&entry.at_ns.to_string(), trigger.kind.as_str(), &trigger.label, &score));
            }
        }
    }

    /// The first trigger that the journal and the clip do not tell alike.
    pub(super) fn moments_differ(&self, clip: &Told) -> Option<Difference> {
        // The clip's limit is for all its lambdas.
        let all = clip.moments.len().max(self.moments.len().min(MOMENTS_MAX / 100));
        (0..all).find_map(|index| {
            let side = |told: &Told| told.moments.get(index).cloned().unwrap_or_else(|| "none".to_owned());
            let (journal, now) = (side(self), side(clip));
            let what = format!("trigger {} of the clip", index + 1);
            (journal != now).then_some(Difference { what, journal, now })
        })
    }

    /// What is missing in the clip, in words; none if nothing is.
    pub(super) fn losses(&self) -> Option<String> {
        (!self.losses.is_empty()).then(|| visible(&self.losses.join(", ")))
    }
}

fn moment(at_ns: &str, kind: &str, label: &str, score: &str) -> String {
    visible(&format!("{kind} `{label}` at {at_ns} ns, score {score}"))
}
