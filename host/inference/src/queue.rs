//! The order of runs: the earliest deadline first, without waiting for a flood.
//!
//! A waiting entry is overtaken at most once by each other owner. So an owner that always has the
//! earliest deadline delays another one by one run at most. Entries that may not be taken yet are
//! passed without that limit.

use std::collections::HashSet;
use std::hash::Hash;

/// Waiting entries, at most one of each owner.
#[derive(Debug)]
pub struct FairQueue<O, T> {
    /// In the order in which they arrived.
    waiting: Vec<QueuedEntry<O, T>>,
}

#[derive(Debug)]
struct QueuedEntry<O, T> {
    owner: O,
    deadline: Option<u64>,
    /// Owners of later entries that were taken before this one.
    overtaken_by: HashSet<O>,
    entry: T,
}

impl<O, T> Default for FairQueue<O, T> {
    fn default() -> Self {
        Self { waiting: Vec::new() }
    }
}

impl<O: Copy + Eq + Hash, T> FairQueue<O, T> {
    /// Adds the entry of an owner that has none in the queue.
    pub fn push(&mut self, owner: O, deadline: Option<u64>, entry: T) {
        debug_assert!(self.waiting.iter().all(|waiting| waiting.owner != owner));
        self.waiting.push(QueuedEntry { owner, deadline, overtaken_by: HashSet::new(), entry });
    }

    pub fn remove(&mut self, owner: O) -> Option<T> {
        let index = self.waiting.iter().position(|waiting| waiting.owner == owner)?;
        Some(self.waiting.remove(index).entry)
    }

    /// Takes the next entry of those that `may` be taken now.
    pub fn pop(&mut self, mut may: impl FnMut(&T) -> bool) -> Option<(O, T)> {
        let mut ready: Vec<_> = self.waiting.iter_mut().filter(|it| may(&it.entry)).collect();
        let may_be_next = |place: &usize| {
            let owner = &ready[*place].owner;
            ready[..*place].iter().all(|earlier| !earlier.overtaken_by.contains(owner))
        };
        // An entry without a deadline comes last; among equal ones, the first that arrived.
        let deadline = |place: &usize| (ready[*place].deadline.unwrap_or(u64::MAX), *place);
        let next = (0..ready.len()).filter(may_be_next).min_by_key(deadline)?;
        let owner = ready[next].owner;
        for earlier in &mut ready[..next] {
            earlier.overtaken_by.insert(owner);
        }
        Some((owner, self.remove(owner)?))
    }

    pub fn entries(&self) -> impl Iterator<Item = &T> {
        self.waiting.iter().map(|waiting| &waiting.entry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_earliest_deadline_is_first_and_entries_without_one_are_last() {
        let mut queue = FairQueue::default();
        for (owner, deadline) in [(1, None), (2, Some(30)), (3, Some(10)), (4, Some(30))] {
            queue.push(owner, deadline, ());
        }
        let popped = std::iter::from_fn(|| queue.pop(|()| true));
        let order: Vec<_> = popped.map(|(owner, ())| owner).collect();
        assert_eq!(order, [3, 2, 4, 1]);
    }

    #[test]
    fn an_owner_overtakes_a_waiting_one_once() {
        let mut queue = FairQueue::default();
        queue.push("slow", None, ());
        let mut order = Vec::new();
        for round in 0..3 {
            queue.push("flood", Some(round), ());
            order.push(queue.pop(|()| true).unwrap().0);
            if order.last() != Some(&"flood") {
                queue.push("slow", None, ());
                queue.remove("flood");
            }
        }
        assert_eq!(order, ["flood", "slow", "flood"]);
    }

    #[test]
    fn two_owners_together_overtake_a_third_one_once_each() {
        let mut queue = FairQueue::default();
        queue.push('c', Some(100), ());
        let mut order = String::new();
        queue.push('a', Some(1), ());
        queue.push('b', Some(2), ());
        for _ in 0..5 {
            let (owner, ()) = queue.pop(|()| true).unwrap();
            order.push(owner);
            // Each returns at once, with an earlier deadline than all others.
            queue.push(owner, Some(if owner == 'c' { 100 } else { 1 }), ());
        }
        assert!(order.starts_with("abc"), "{order}");
    }

    #[test]
    fn a_removed_entry_is_not_taken() {
        let mut queue = FairQueue::default();
        queue.push(1, Some(1), 'a');
        queue.push(2, Some(2), 'b');
        assert_eq!((queue.remove(1), queue.remove(1)), (Some('a'), None));
        let mut pop = || queue.pop(|_| true);
        assert_eq!((pop(), pop()), (Some((2, 'b')), None));
    }
}
