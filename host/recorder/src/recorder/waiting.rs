//! Triggers that are in no clip yet: the window that they opened waits, or they came in a cooldown.

use std::collections::VecDeque;

use gleaner_protocol::Moment;

use crate::window::Group;

/// Most triggers that wait. A lambda can trigger often, and windows wait for minutes.
const WAITING_MAX: usize = 10_000;

/// Triggers in order of their wakes.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    moments: VecDeque<(usize, Moment)>,
    /// Those beyond [`WAITING_MAX`]: the next clip counts them.
    untold: u64,
}

impl Waiting {
    /// A trigger came. Nobody will ask for those before `horizon`.
    pub(super) fn push(&mut self, lambda: usize, moment: Moment, horizon: i64) {
        while self.moments.front().is_some_and(|(_, moment)| moment.at_ns < horizon) {
            self.moments.pop_front();
        }
        if self.moments.len() < WAITING_MAX {
            self.moments.push_back((lambda, moment));
        } else {
            self.untold += 1;
        }
    }

    /// The trigger of `lambda` at `at_ns`, if it waits.
    pub(super) fn find(&self, lambda: usize, at_ns: i64) -> Option<&Moment> {
        self.moments.iter().find(|(whose, moment)| *whose == lambda && moment.at_ns == at_ns).map(|(_, moment)| moment)
    }

    /// Takes those out that are within `group` and not after `limit`, and how many more there were.
    pub(super) fn take(&mut self, group: &Group, limit: i64, mut each: impl FnMut(Moment)) -> u64 {
        let inside = group.begin..=group.to.min(limit);
        for _ in 0..self.moments.len() {
            let Some((lambda, moment)) = self.moments.pop_front() else { break };
            if inside.contains(&moment.at_ns) && group.lambdas.contains(&lambda) {
                each(moment);
            } else {
                self.moments.push_back((lambda, moment));
            }
        }
        std::mem::take(&mut self.untold)
    }
}
