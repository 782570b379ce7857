//! Pairs the wakes of two runs. Both files are read once, side by side.

use std::collections::{HashMap, VecDeque};

use gleaner_lambda::{Cause, Decision};

use crate::results::ResultsError;

/// Maximum number of wakes at one instant; those of each run are held in memory.
pub(super) const WAKES_PER_INSTANT: usize = 65_536;
/// Maximum number of bytes of their lines, if there are several.
pub(super) const BYTES_PER_INSTANT: usize = 32 << 20;

#[derive(Debug)]
pub(super) enum WakesError {
    Read(ResultsError),
    /// Too many wakes at one instant, in the first run or in the second.
    Crowded {
        first: bool,
    },
}

/// A wake of both runs; `None` for a run that lacks it, or in which it neither triggered nor
/// faulted.
#[derive(Debug)]
pub(super) struct Pair {
    pub(super) a: Option<Decision>,
    pub(super) b: Option<Decision>,
    /// True if a wake with a later time came before.
    pub(super) out_of_order: bool,
}

pub(super) struct Pairs<'a, A, B> {
    a: WakeStream<'a, A>,
    b: WakeStream<'a, B>,
    ready: VecDeque<Pair>,
    /// Set after an error, which is the last item.
    ended: bool,
}

impl<'a, A, B> Pairs<'a, A, B>
where
    A: Iterator<Item = Result<(Decision, usize), ResultsError>>,
    B: Iterator<Item = Result<(Decision, usize), ResultsError>>,
{
    pub(super) fn new(a: &'a mut A, b: &'a mut B) -> Self {
        let (a, b) = (WakeStream::new(a, true), WakeStream::new(b, false));
        Self { a, b, ready: VecDeque::new(), ended: false }
    }

    /// Pairs the wakes of the next instant that has any.
    fn fill(&mut self) -> Result<(), WakesError> {
        let instant = match (self.a.peek()?, self.b.peek()?) {
            (Some(a), Some(b)) => a.min(b),
            (Some(only), None) | (None, Some(only)) => only,
            (None, None) => return Ok(()),
        };
        let (of_a, late_a) = self.a.at(instant)?;
        let (of_b, late_b) = self.b.at(instant)?;
        let out_of_order = late_a || late_b;
        let (mut by_number, mut by_name) = (HashMap::new(), HashMap::new());
        for (place, decision) in of_b.iter().enumerate() {
            let name = WakeKey::of(decision);
            by_number
                .entry((name.clone(), decision.seq))
                .or_insert_with(VecDeque::new)
                .push_back(place);
            by_name.entry(name).or_insert_with(VecDeque::new).push_back(place);
        }
        let mut left: Vec<_> = of_b.into_iter().map(Some).collect();
        let mut take = |places: Option<&mut VecDeque<usize>>| {
            let places = places?;
            std::iter::from_fn(|| places.pop_front()).find_map(|place| left[place].take())
        };
        for decision in of_a {
            let b = take(by_number.get_mut(&(WakeKey::of(&decision), decision.seq)));
            self.ready.push_back(Pair { a: Some(decision), b, out_of_order });
        }
        // Then those with other sequence numbers, in the order of the files: if a part of a drive
        // was replayed, its samples may be numbered from its start.
        for pair in self.ready.iter_mut().filter(|pair| pair.b.is_none()) {
            pair.b = pair.a.as_ref().and_then(|a| take(by_name.get_mut(&WakeKey::of(a))));
        }
        let rest = left.into_iter().flatten();
        self.ready.extend(rest.map(|b| Pair { a: None, b: Some(b), out_of_order }));
        Ok(())
    }
}

impl<A, B> Iterator for Pairs<'_, A, B>
where
    A: Iterator<Item = Result<(Decision, usize), ResultsError>>,
    B: Iterator<Item = Result<(Decision, usize), ResultsError>>,
{
    type Item = Result<Pair, WakesError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ready.is_empty()
            && !self.ended
            && let Err(error) = self.fill()
        {
            self.ended = true;
            return Some(Err(error));
        }
        self.ready.pop_front().map(Ok)
    }
}

#[derive(Clone, PartialEq, Eq, Hash)]
struct WakeKey {
    at_ns: i64,
    cause: Cause,
    topic: Option<String>,
}

impl WakeKey {
    fn of(decision: &Decision) -> Self {
        let Decision { at_ns, cause, topic, .. } = decision;
        Self { at_ns: *at_ns, cause: *cause, topic: topic.clone() }
    }
}

/// Reads the wakes of one run instant by instant.
struct WakeStream<'a, I> {
    decisions: &'a mut I,
    is_first: bool,
    /// The next decision with a trigger or a fault, the instant that it counts to, and the bytes of
    /// its line.
    next: Option<(i64, Decision, usize)>,
    /// The latest time so far. A later line with an earlier time counts to this instant, so that
    /// instants never go back.
    latest: i64,
    has_read_next: bool,
}

impl<'a, I: Iterator<Item = Result<(Decision, usize), ResultsError>>> WakeStream<'a, I> {
    fn new(decisions: &'a mut I, is_first: bool) -> Self {
        Self { decisions, is_first, next: None, latest: i64::MIN, has_read_next: false }
    }

    fn peek(&mut self) -> Result<Option<i64>, WakesError> {
        if !self.has_read_next {
            self.has_read_next = true;
            // With `--all` a run lists quiet wakes, too. They are ignored.
            let is_relevant =
                |decision: &Decision| !decision.triggers.is_empty() || decision.fault.is_some();
            let next = self
                .decisions
                .find(|next| next.as_ref().map_or(true, |(decision, _)| is_relevant(decision)));
            let next = next.transpose().map_err(WakesError::Read)?;
            self.next = next.map(|(decision, bytes)| {
                self.latest = self.latest.max(decision.at_ns);
                (self.latest, decision, bytes)
            });
        }
        Ok(self.next.as_ref().map(|(instant, ..)| *instant))
    }

    /// Returns the wakes of `instant`, and whether any of them has another time.
    fn at(&mut self, instant: i64) -> Result<(Vec<Decision>, bool), WakesError> {
        let (mut wakes, mut held, mut is_late) = (Vec::new(), 0, false);
        while self.peek()? == Some(instant) {
            self.has_read_next = false;
            let Some((_, decision, bytes)) = self.next.take() else { continue };
            held += bytes;
            if wakes.len() == WAKES_PER_INSTANT || (held > BYTES_PER_INSTANT && !wakes.is_empty()) {
                return Err(WakesError::Crowded { first: self.is_first });
            }
            is_late |= decision.at_ns != instant;
            wakes.push(decision);
        }
        Ok((wakes, is_late))
    }
}
