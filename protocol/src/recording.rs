//! The counts of a recorder: clips, windows, and missing data by cause.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use gleaner_base::grouped;

/// Generates the code of the table: the counts, their sum, and their text.
///
/// A count of missing data has its text after `=>`: singular, plural, and the cause.
macro_rules! recording {
    ($(
        $(#[doc = $meaning:literal])+
        $key:ident $(=> $outcome:ident $one:literal, $many:literal, $why:literal)?;
    )+) => {
        /// Counts of a recorder since its start; each count has one cause.
        ///
        /// They are part of a replay's summary, and of the reports of a live recorder. Counts that
        /// an older file lacks are 0.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        #[serde(default)]
        pub struct RecordingCounts {
            $($(#[doc = $meaning])+ pub $key: u64,)+
        }

        impl RecordingCounts {
            /// Adds the counts of another recorder.
            pub fn add(&mut self, other: &RecordingCounts) {
                $(self.$key = self.$key.saturating_add(other.$key);)+
            }

            /// Returns each count of missing data, with its cause; also those that are 0.
            pub fn by_cause(&self) -> Vec<LossCount> {
                let mut all = Vec::new();
                $($(all.push(LossCount {
                    outcome: LossOutcome::$outcome,
                    count: self.$key,
                    label: concat!($many, " ", $why),
                    thing: if self.$key == 1 { $one } else { $many },
                    why: $why,
                });)?)+
                all
            }
        }
    };
}

recording! {
    /// Finished clips.
    clips;

    /// Windows that triggers and commands opened.
    windows;

    /// Triggers within the cooldown of another, which opened no window.
    in_cooldown => NoWindow "trigger", "triggers", "within the cooldown of another";

    /// Starts of a running recording, and stops of none.
    ignored => NoWindow "start or stop", "starts or stops",
        "of a recording that was already running, or not running";

    /// Starts beyond the maximum of running recordings of the lambda.
    too_many_started => Lost "start", "starts", "over the maximum of recordings of a lambda";

    /// Triggers beyond the maximum of windows that wait for their clip.
    too_many_waiting => Lost "trigger", "triggers",
        "over the maximum of windows that wait for their clip";

    /// Triggers except stops, and commands, that opened no window, as the disk had too little
    /// space.
    disk_suppressed => Lost "trigger", "triggers", "without a window: the disk was too full";

    /// Triggers of wakes that were refused, as the lambda exceeded the recorder's rate limit of
    /// triggers or bytes.
    triggers_over_rate => Lost "trigger", "triggers", "over the recorder's rate limit of a lambda";

    /// Triggers of wakes that were refused for stamps too far in the past or future.
    triggers_misstamped => Lost "trigger", "triggers", "with a wrong time";

    /// Wakes that did not reach the recorder: the journals of clips lack them, and the ones below.
    wakes_lost => Lost "wake", "wakes", "not in any journal: they did not reach the recorder";

    /// Wakes that were refused, as the lambda exceeded the recorder's rate limit of triggers or
    /// bytes.
    wakes_over_rate => Lost "wake", "wakes",
        "not in any journal: over the recorder's rate limit of a lambda";

    /// Wakes that were refused for stamps too far in the past or future.
    wakes_misstamped => Lost "wake", "wakes", "not in any journal: with a wrong time";

    /// Clips that could not be written or recovered. Their remains are recovered when the folder is
    /// opened again.
    failed => Lost "clip", "clips", "not written";

    /// Clips that were deleted to make room before they were fetched.
    deleted => Lost "clip", "clips", "deleted before being fetched";

    /// Clips that should have been deleted to make room, and could not be.
    not_deleted => Kept "clip", "clips", "not deleted to make room: see losses.jsonl";

    /// Clips that should have been signed and could not be.
    unsigned => Kept "clip", "clips", "without a signature: see the recorder's log";

    /// Samples that left the full preroll before they were too old for any window.
    evicted_early => Lost "sample", "samples", "evicted from the preroll too early: preroll_size";

    /// Samples larger than the preroll. They are in a clip only if it is open when they arrive, and
    /// if they are below the maximum for a message, somewhat below 1 GiB.
    too_big => Lost "sample", "samples", "larger than the preroll: preroll_size";

    /// Samples and wakes with a stamp before 1970, which are not recorded.
    before_1970 => Lost "sample or wake", "samples or wakes", "stamped before 1970";

    /// Samples of a topic that was not known yet, which are not recorded.
    topic_unknown => Lost "sample", "samples", "of a topic not yet known";

    /// Lambdas that the recorder refused; its log has the reasons.
    lambdas_refused => Lost "lambda", "lambdas", "refused: see the recorder's log";
}

/// The outcome of counted data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LossOutcome {
    /// The data opened no window, as the manifest requires.
    NoWindow,
    /// The data is lost.
    Lost,
    /// The data was kept, and should not have been, or not in this form.
    Kept,
}

/// A count of missing data, with its cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LossCount {
    /// The outcome.
    pub outcome: LossOutcome,
    /// The count.
    pub count: u64,
    /// The counted data with the cause, for a table.
    pub label: &'static str,
    thing: &'static str,
    why: &'static str,
}

impl LossCount {
    /// Returns the count as text, for example `no window: 2 triggers, within the cooldown of
    /// another`.
    pub fn describe(&self) -> String {
        let LossCount { outcome, count, thing, why, .. } = self;
        let outcome = match outcome {
            LossOutcome::NoWindow => "no window",
            LossOutcome::Lost => "lost",
            LossOutcome::Kept => "kept",
        };
        format!("{outcome}: {} {thing}, {why}", grouped(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_count_is_added_and_shown_by_itself() {
        let all = serde_json::to_value(RecordingCounts::default()).unwrap();
        let mut shown = 0;
        for key in all.as_object().unwrap().keys() {
            let text = format!(r#"{{"{key}":2000,"of a newer version":"x"}}"#);
            let one: RecordingCounts = serde_json::from_str(&text).unwrap();
            let mut sum = one;
            sum.add(&one);
            assert_eq!(serde_json::to_value(sum).unwrap()[key], 4000, "{key}");
            let counted: Vec<_> =
                one.by_cause().into_iter().filter(|counted| counted.count > 0).collect();
            assert_eq!(counted.is_empty(), ["clips", "windows"].contains(&key.as_str()), "{key}");
            shown += counted.len();
        }
        assert_eq!(shown, RecordingCounts::default().by_cause().len());
    }

    #[test]
    fn a_count_is_shown_with_its_cause() {
        let few = RecordingCounts {
            in_cooldown: 1,
            evicted_early: 3000,
            not_deleted: 1,
            ..RecordingCounts::default()
        };
        let shown = few.by_cause().into_iter().filter(|counted| counted.count > 0);
        assert_eq!(
            shown.map(|counted| counted.describe()).collect::<Vec<_>>(),
            [
                "no window: 1 trigger, within the cooldown of another",
                "kept: 1 clip, not deleted to make room: see losses.jsonl",
                "lost: 3,000 samples, evicted from the preroll too early: preroll_size",
            ]
        );
    }
}
