//! Sets of instants, as sorted, disjoint intervals with both ends inclusive.

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Intervals(Vec<(i64, i64)>);

/// Beyond this number of intervals, those before the horizon are dropped.
const PRUNE_ABOVE: usize = 4096;

impl Intervals {
    /// Adds `from..=to`, merged with the intervals that it touches. Instants before `horizon` will
    /// not be queried.
    pub fn insert(&mut self, from: i64, to: i64, horizon: i64) {
        if self.0.len() >= PRUNE_ABOVE {
            let old = self.0.partition_point(|(_, end)| *end < horizon);
            self.0.drain(..old);
        }
        let first = self.0.partition_point(|(_, end)| *end < from);
        let last = self.0.partition_point(|(begin, _)| *begin <= to);
        let merged = self.0[first..last]
            .iter()
            .fold((from, to), |(a, b), (from, to)| (a.min(*from), b.max(*to)));
        self.0.splice(first..last, [merged]);
    }

    pub fn contains(&self, at: i64) -> bool {
        self.0
            .get(self.0.partition_point(|(_, end)| *end < at))
            .is_some_and(|(begin, _)| *begin <= at)
    }

    pub fn first_outside(&self, from: i64, to: i64) -> Option<i64> {
        match self.0.get(self.0.partition_point(|(_, end)| *end < from)) {
            Some((begin, end)) if *begin <= from => (*end < to).then(|| end.saturating_add(1)),
            _ => Some(from),
        }
    }

    pub fn end(&self) -> Option<i64> {
        self.0.last().map(|(_, end)| *end)
    }

    /// Returns the number of intervals that end after `at`.
    pub fn beyond(&self, at: i64) -> u64 {
        (self.0.len() - self.0.partition_point(|(_, end)| *end <= at)) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_that_share_an_instant_are_merged() {
        let mut intervals = Intervals::default();
        intervals.insert(10, 20, 0);
        intervals.insert(30, 40, 0);
        intervals.insert(50, 60, 0);
        assert_eq!(intervals.0, [(10, 20), (30, 40), (50, 60)]);
        intervals.insert(20, 30, 0);
        assert_eq!(intervals.0, [(10, 40), (50, 60)]);
        intervals.insert(1, 2, 0);
        intervals.insert(0, 100, 0);
        assert_eq!(intervals.0, [(0, 100)]);
    }

    #[test]
    fn both_ends_belong_to_an_interval() {
        let mut intervals = Intervals::default();
        intervals.insert(10, 20, 0);
        intervals.insert(30, 30, 0);
        let inside: Vec<_> = (8..32).filter(|at| intervals.contains(*at)).collect();
        assert_eq!(inside, (10..=20).chain([30]).collect::<Vec<_>>());
        let outside = [(10, 20), (10, 21), (20, 30), (9, 9), (30, 40)]
            .map(|(a, b)| intervals.first_outside(a, b));
        assert_eq!(outside, [None, Some(21), Some(21), Some(9), Some(31)]);
        assert_eq!((intervals.end(), intervals.beyond(20), intervals.beyond(30)), (Some(30), 1, 0));
    }

    #[test]
    fn old_intervals_are_dropped_once_they_are_many() {
        let mut intervals = Intervals::default();
        for at in 0..100_000 {
            intervals.insert(at * 10, at * 10, at * 10 - 1000);
        }
        assert!(intervals.0.len() <= PRUNE_ABOVE, "{}", intervals.0.len());
        assert!(intervals.contains(999_990) && intervals.contains(999_000));
    }
}
