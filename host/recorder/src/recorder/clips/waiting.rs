//! Triggers that are in no clip yet: their window waits, or they came in a cooldown.

use std::collections::{BTreeMap, VecDeque};
use std::ops::RangeInclusive;

use gleaner_lambda::Moment;

use crate::window::{Group, Windows};

/// Triggers in order of their wakes.
#[derive(Debug, Default)]
pub struct WaitingTriggers {
    moments: VecDeque<(usize, Moment)>,
    /// Triggers without room, which are only counted, by lambda.
    counted: BTreeMap<usize, CountedTriggers>,
}

/// Triggers of one lambda that are only counted.
#[derive(Copy, Clone, Debug)]
struct CountedTriggers {
    from: i64,
    to: i64,
    count: u64,
}

impl WaitingTriggers {
    /// Adds a trigger. At most `most` wait: beyond it, the oldest that no window covers is dropped,
    /// or else the new one.
    pub fn push(&mut self, lambda: usize, moment: Moment, windows: &Windows, most: usize) {
        let horizon = windows.horizon();
        while self.moments.front().is_some_and(|(_, moment)| moment.at_ns < horizon) {
            self.moments.pop_front();
        }
        self.counted.retain(|_, counted| counted.to >= horizon);
        if self.moments.len() < most {
            self.moments.push_back((lambda, moment));
            return;
        }
        let (owner, at) = match self
            .moments
            .iter()
            .position(|(owner, moment)| !windows.covers(*owner, moment.at_ns))
        {
            Some(index) => {
                let gone = self
                    .moments
                    .remove(index)
                    .map_or((lambda, moment.at_ns), |(owner, gone)| (owner, gone.at_ns));
                self.moments.push_back((lambda, moment));
                gone
            }
            None => (lambda, moment.at_ns),
        };
        let counted =
            self.counted.entry(owner).or_insert(CountedTriggers { from: at, to: at, count: 0 });
        *counted = CountedTriggers {
            from: counted.from.min(at),
            to: counted.to.max(at),
            count: counted.count + 1,
        };
    }

    pub fn find(&self, lambda: usize, at_ns: i64) -> Option<&Moment> {
        self.moments
            .iter()
            .find(|(owner, moment)| *owner == lambda && moment.at_ns == at_ns)
            .map(|(_, moment)| moment)
    }

    /// Takes the triggers within `group` and not after `limit`; returns the number of further ones
    /// that were only counted.
    pub fn take(&mut self, group: &Group, limit: i64, mut each: impl FnMut(Moment)) -> u64 {
        let inside = inside(group, limit);
        for _ in 0..self.moments.len() {
            let Some((lambda, moment)) = self.moments.pop_front() else { break };
            if inside.contains(&moment.at_ns) && group.lambdas.contains(&lambda) {
                each(moment);
            } else {
                self.moments.push_back((lambda, moment));
            }
        }
        let mut count = 0;
        self.counted.retain(|lambda, counted| {
            // Not those of the clip before, if this one continues it.
            let is_inside = group.from <= counted.from && counted.to <= *inside.end();
            let is_taken = is_inside && group.lambdas.contains(lambda);
            count += if is_taken { counted.count } else { 0 };
            !is_taken
        });
        count
    }

    /// The lambdas with possibly more triggers within `group` and not after `limit` than were
    /// taken: they were only counted, and some of them lie outside.
    pub fn uncertain(&self, group: &Group, limit: i64) -> Vec<usize> {
        let inside = inside(group, limit);
        let overlaps = |counted: &CountedTriggers| {
            counted.from <= *inside.end() && *inside.start() <= counted.to
        };
        let uncertain = self
            .counted
            .iter()
            .filter(|(lambda, counted)| group.lambdas.contains(lambda) && overlaps(counted));
        uncertain.map(|(lambda, _)| *lambda).collect()
    }
}

fn inside(group: &Group, limit: i64) -> RangeInclusive<i64> {
    group.begin..=group.to.min(limit)
}
