//! The wakes of two runs in pairs, out of two files that are read once, side by side.

use std::collections::{HashMap, VecDeque};

use gleaner_lambda::{Cause, Decision};

use crate::results::ResultsError;

/// Most wakes at one instant, and most bytes of their lines if they are several: so much of each
/// run is held in memory.
pub(super) const AT_ONCE: usize = 65_536;
pub(super) const BYTES_AT_ONCE: usize = 32 << 20;

/// Why there are no further pairs.
#[derive(Debug)]
pub(super) enum WakesError {
    Read(ResultsError),
    /// In the first of both, or in the second.
    Crowded {
        first: bool,
    },
}

/// A wake, as both runs have it; `None` where a run has it not, or where it neither triggered nor
/// faulted.
#[derive(Debug)]
pub(super) struct Pair {
    pub(super) a: Option<Decision>,
    pub(super) b: Option<Decision>,
    /// It comes after one with a later time.
    pub(super) out_of_order: bool,
}

/// Walks through both.
pub(super) struct Pairs<'a, A, B> {
    a: Side<'a, A>,
    b: Side<'a, B>,
    ready: VecDeque<Pair>,
    /// Nothing comes after an error.
    ended: bool,
}

impl<'a, A, B> Pairs<'a, A, B>
where
    A: Iterator<Item = Result<(Decision, usize), ResultsError>>,
    B: Iterator<Item = Result<(Decision, usize), ResultsError>>,
{
    pub(super) fn new(a: &'a mut A, b: &'a mut B) -> Self {
        let (a, b) = (Side::new(a, true), Side::new(b, false));
        Self { a, b, ready: VecDeque::new(), ended: false }
    }

    /// Pairs the wakes of the next instant at which there are any.
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
            let name = Name::of(decision);
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
            let b = take(by_number.get_mut(&(Name::of(&decision), decision.seq)));
            self.ready.push_back(Pair { a: Some(decision), b, out_of_order });
        }
        // Then those of other numbers, in the order of the files: of a part of a drive, samples may
        // be counted from its begin.
        for pair in self.ready.iter_mut().filter(|pair| pair.b.is_none()) {
            pair.b = pair.a.as_ref().and_then(|a| take(by_name.get_mut(&Name::of(a))));
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

/// What a wake is known by, beside its time.
#[derive(Clone, PartialEq, Eq, Hash)]
struct Name {
    at_ns: i64,
    cause: Cause,
    topic: Option<String>,
}

impl Name {
    fn of(decision: &Decision) -> Self {
        let Decision { at_ns, cause, topic, .. } = decision;
        Self { at_ns: *at_ns, cause: *cause, topic: topic.clone() }
    }
}

/// One run, instant by instant.
struct Side<'a, I> {
    decisions: &'a mut I,
    is_first: bool,
    /// The next one that triggered or faulted, the instant that it counts to, and the bytes of its
    /// line.
    next: Option<(i64, Decision, usize)>,
    /// The latest time so far: who comes later with an earlier one counts to this instant, so that
    /// instants never go back.
    latest: i64,
    asked: bool,
}

impl<'a, I: Iterator<Item = Result<(Decision, usize), ResultsError>>> Side<'a, I> {
    fn new(decisions: &'a mut I, is_first: bool) -> Self {
        Self { decisions, is_first, next: None, latest: i64::MIN, asked: false }
    }

    fn peek(&mut self) -> Result<Option<i64>, WakesError> {
        if !self.asked {
            self.asked = true;
            // With `--all` a run has quiet wakes, too: they are as good as none.
            let speaks =
                |decision: &Decision| !decision.triggers.is_empty() || decision.fault.is_some();
            let next = self
                .decisions
                .find(|next| next.as_ref().map_or(true, |(decision, _)| speaks(decision)));
            let next = next.transpose().map_err(WakesError::Read)?;
            self.next = next.map(|(decision, bytes)| {
                self.latest = self.latest.max(decision.at_ns);
                (self.latest, decision, bytes)
            });
        }
        Ok(self.next.as_ref().map(|(instant, ..)| *instant))
    }

    /// The wakes of `instant`, and whether any has another time.
    fn at(&mut self, instant: i64) -> Result<(Vec<Decision>, bool), WakesError> {
        let (mut wakes, mut held, mut is_late) = (Vec::new(), 0, false);
        while self.peek()? == Some(instant) {
            self.asked = false;
            let Some((_, decision, bytes)) = self.next.take() else { continue };
            held += bytes;
            if wakes.len() == AT_ONCE || (held > BYTES_AT_ONCE && !wakes.is_empty()) {
                return Err(WakesError::Crowded { first: self.is_first });
            }
            is_late |= decision.at_ns != instant;
            wakes.push(decision);
        }
        Ok((wakes, is_late))
    }
}
