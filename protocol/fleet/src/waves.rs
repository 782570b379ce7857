//! Waves: a release reaches a part of its vehicles first, and the others once it has proved itself.

use serde::{Deserialize, Serialize};

/// Maximum number of waves before the last one.
pub const WAVES_MAX: usize = 20;

/// Longest time in a plan, in s: a year.
const SECONDS_MAX: u64 = 366 * 86_400;

/// The plan by which a release reaches its vehicles.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WavePlan {
    /// The share of its vehicles that each wave reaches, with those before, in percent. One more
    /// wave reaches all.
    pub shares: Vec<u8>,
    /// The share of the vehicles so far that must run it before the next wave, in percent.
    pub success: u8,
    /// The share of the vehicles so far that may fail; above it, the waves stop.
    pub failures: u8,
    /// The time for which a wave is open at least, in s: a lambda may fail late.
    pub soak_s: u64,
    /// The time after which a wave that has not succeeded stops, in s.
    pub deadline_s: u64,
    /// The action when too many vehicles fail.
    pub on_failure: OnFailure,
}

/// The action when too many vehicles fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum OnFailure {
    /// The release reaches no more vehicles until a person decides.
    Pause,
    /// The release reaches no more vehicles, and those that have it run its fallback.
    Rollback,
}

/// The state of the waves of a release.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum WaveState {
    /// The next wave opens once this one has succeeded.
    Running,
    /// No wave opens until a person resumes them.
    Paused,
    /// No wave opens any more.
    Aborted,
}

/// The progress of a release that has not reached all its vehicles.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct WaveProgress {
    /// The plan.
    pub plan: WavePlan,
    /// Number of the newest open wave: 1 is the first.
    pub wave: u64,
    /// Number of all waves, with the last one, which reaches all vehicles.
    pub waves: u64,
    /// The state.
    pub state: WaveState,
    /// The reason of the state; empty while they run.
    pub reason: String,
    /// Time since which the wave is open or the state holds, in s since 1970.
    pub since: u64,
    /// Number of vehicles that the waves have reached.
    pub vehicles: u64,
    /// Number of these that run the release, and are connected or were so after the soak time.
    pub running: u64,
    /// Number of these that refuse it, or whose lambda has failed.
    pub failed: u64,
}

impl WavePlan {
    /// Checks a plan.
    ///
    /// # Errors
    ///
    /// The reason why it cannot be followed.
    pub fn check(&self) -> Result<(), String> {
        let Self { shares, success, failures, soak_s, deadline_s, .. } = self;
        let is_share = |share: &u8| (1..100).contains(share);
        let grows = shares.is_sorted_by(|before, next| before < next);
        match () {
            () if shares.is_empty() || shares.len() > WAVES_MAX => {
                Err(format!("a plan has 1 to {WAVES_MAX} waves before the last one"))
            }
            () if !grows || !shares.iter().all(is_share) => {
                Err("waves reach 1 % to 99 %, each more than the one before".to_owned())
            }
            () if !(1..=100).contains(success) => {
                Err("a wave succeeds at 1 % to 100 % of its vehicles".to_owned())
            }
            () if *failures > 100 => Err("at most 100 % of vehicles may fail".to_owned()),
            () if *deadline_s == 0 || soak_s >= deadline_s || *deadline_s > SECONDS_MAX => {
                Err("the deadline of a wave is after its soak time, and within a year".to_owned())
            }
            () => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_that_cannot_be_followed_is_refused_with_the_reason() {
        let plan = WavePlan {
            shares: vec![5, 25],
            success: 95,
            failures: 5,
            soak_s: 600,
            deadline_s: 86_400,
            on_failure: OnFailure::Pause,
        };
        assert_eq!(plan.check(), Ok(()));
        for (bad, reason) in [
            (WavePlan { shares: vec![], ..plan.clone() }, "1 to 20 waves"),
            (WavePlan { shares: vec![25, 25], ..plan.clone() }, "more than the one before"),
            (WavePlan { shares: vec![0], ..plan.clone() }, "1 % to 99 %"),
            (WavePlan { shares: vec![100], ..plan.clone() }, "1 % to 99 %"),
            (WavePlan { success: 0, ..plan.clone() }, "at 1 % to 100 %"),
            (WavePlan { failures: 101, ..plan.clone() }, "at most 100 %"),
            (WavePlan { soak_s: 86_400, ..plan.clone() }, "after its soak time"),
            (WavePlan { deadline_s: u64::MAX, ..plan }, "within a year"),
        ] {
            let refused = bad.check().unwrap_err();
            assert!(refused.contains(reason), "{refused}");
        }
    }
}
