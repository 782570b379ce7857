use serde::{Deserialize, Serialize};

use gleaner_base::grouped;

/// Makes all of the table: the counts, their sum, and how each is shown.
///
/// A count of what is missing has after `=>` what it is shown as: one of it, several, and the
/// cause.
macro_rules! recording {
    ($($(#[doc = $meaning:literal])+ $key:ident $(=> $outcome:ident $one:literal, $many:literal, $why:literal)?;)+) => {
        /// What a recorder counted since its start: each count has one cause.
        ///
        /// It is a part of a replay's summary, and of what a recorder reports live. Of an older
        /// file, missing counts are 0.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default)]
        pub struct RecordingCounts {
            $($(#[doc = $meaning])+ pub $key: u64,)+
        }

        impl RecordingCounts {
            /// Adds what another recorder counted.
            pub fn add(&mut self, other: &RecordingCounts) {
                $(self.$key = self.$key.saturating_add(other.$key);)+
            }

            /// Each count of something that is missing, by its cause; also those that are 0.
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
    /// Clips that are finished.
    clips;

    /// Windows that triggers and commands opened.
    windows;

    /// Triggers that opened no window, as they came within the cooldown of another.
    in_cooldown => NoWindow "trigger", "triggers", "within the cooldown of another";

    /// Starts of a recording that was running, and stops of none.
    ignored => NoWindow "start or stop", "starts or stops", "of a recording that ran already or did not run";

    /// Starts while as many recordings of the lambda were running as may.
    too_many_started => Lost "start", "starts", "while as many recordings of the lambda ran as may";

    /// Triggers while as many windows waited for their clip as may.
    too_many_waiting => Lost "trigger", "triggers", "while as many windows waited for their clip as may";

    /// Triggers but for stops, and commands, that opened no window, as the disk had too little
    /// room.
    disk_suppressed => Lost "trigger", "triggers", "without a window: the disk was too full";

    /// Triggers of wakes that were refused, as the lambda causes more of them, or more bytes, than
    /// the recorder takes of one.
    triggers_over_rate => Lost "trigger", "triggers", "beyond what the recorder takes of one lambda";

    /// Triggers of wakes that were refused, as their stamps were of another time.
    triggers_misstamped => Lost "trigger", "triggers", "of another time than the recorder's";

    /// Wakes that did not reach the recorder: the journals of clips lack them, and the ones below.
    wakes_lost => Lost "wake", "wakes", "not in any journal: they did not reach the recorder";

    /// Wakes that were refused, as the lambda causes more triggers or bytes than the recorder takes
    /// of one.
    wakes_over_rate => Lost "wake", "wakes", "not in any journal: beyond what the recorder takes of one lambda";

    /// Wakes that were refused, as their stamps were of another time.
    wakes_misstamped => Lost "wake", "wakes", "not in any journal: of another time than the recorder's";

    /// Clips that could not be written, or recovered. What there is of them is recovered when the
    /// folder is opened again.
    failed => Lost "clip", "clips", "not written";

    /// Clips that were deleted to make room, and that nobody had fetched.
    deleted => Lost "clip", "clips", "deleted before being fetched";

    /// Clips that should have been deleted to make room, and could not be.
    not_deleted => Kept "clip", "clips", "not deleted to make room: losses.jsonl says why";

    /// Samples that left the preroll for want of bytes before they were too old for any window.
    evicted_early => Lost "sample", "samples", "pushed out of the preroll too early: preroll_size";

    /// Samples that are larger than the preroll. While a clip is open, they are in it nevertheless,
    /// unless they are larger than any message of a clip, which is somewhat below 1 GiB.
    too_big => Lost "sample", "samples", "larger than the preroll: preroll_size";

    /// Samples and wakes with a stamp before 1970: they are not recorded.
    before_1970 => Lost "sample or wake", "samples or wakes", "stamped before 1970";

    /// Samples of a topic that was not known yet: they are not recorded.
    topic_unknown => Lost "sample", "samples", "of a topic not yet known";

    /// Lambdas that the recorder was told of and does not record for; the log says why.
    lambdas_refused => Lost "lambda", "lambdas", "not recorded for: the recorder has said why";
}

/// What came of something that is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LossOutcome {
    /// It opened no window, as the manifest wants it.
    NoWindow,
    /// It is lost.
    Lost,
    /// It is there, and should not be.
    Kept,
}

/// A count of something that is missing, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LossCount {
    /// What came of it.
    pub outcome: LossOutcome,
    /// How many.
    pub count: u64,
    /// What is counted, with its cause: for a table.
    pub label: &'static str,
    thing: &'static str,
    why: &'static str,
}

impl LossCount {
    /// Returns the count in words, for example `no window: 2 triggers, within the cooldown of
    /// another`.
    pub fn in_words(&self) -> String {
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
            shown.map(|counted| counted.in_words()).collect::<Vec<_>>(),
            [
                "no window: 1 trigger, within the cooldown of another",
                "kept: 1 clip, not deleted to make room: losses.jsonl says why",
                "lost: 3,000 samples, pushed out of the preroll too early: preroll_size",
            ]
        );
    }
}
