//! The wakes of two runs in pairs, out of two files that are read once, side by side.

use std::collections::{HashMap, VecDeque};

use gleaner_protocol::{Cause, Decision};

use crate::results::ResultsError;

/// Most wakes at one instant: so many are held in memory.
pub(super) const AT_ONCE: usize = 65_536;

/// Why there are no further pairs.
#[derive(Debug)]
pub(super) enum WakesError {
    Read(ResultsError),
    /// In the first of both, or in the second.
    Crowded {
        first: bool,
    },
}

/// A wake, as both runs have it; `None` where a run has it not, or where it neither triggered nor faulted.
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
    A: Iterator<Item = Result<Decision, ResultsError>>,
    B: Iterator<Item = Result<Decision, ResultsError>>,
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
        let mut by_name: HashMap<Name, VecDeque<Decision>> = HashMap::new();
        let mut names = Vec::new();
        for decision in of_b {
            let name = Name::of(&decision);
            names.push(name.clone());
            by_name.entry(name).or_default().push_back(decision);
        }
        for decision in of_a {
            let b = by_name.get_mut(&Name::of(&decision)).and_then(VecDeque::pop_front);
            self.ready.push_back(Pair { a: Some(decision), b, out_of_order });
        }
        // What is left, in the order of the file.
        for name in names {
            if let Some(b) = by_name.get_mut(&name).and_then(VecDeque::pop_front) {
                self.ready.push_back(Pair { a: None, b: Some(b), out_of_order });
            }
        }
        Ok(())
    }
}

impl<A, B> Iterator for Pairs<'_, A, B>
where
    A: Iterator<Item = Result<Decision, ResultsError>>,
    B: Iterator<Item = Result<Decision, ResultsError>>,
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
    seq: Option<u64>,
}

impl Name {
    fn of(decision: &Decision) -> Self {
        let Decision { at_ns, cause, topic, seq, .. } = decision;
        Self { at_ns: *at_ns, cause: *cause, topic: topic.clone(), seq: *seq }
    }
}

/// One run, instant by instant.
struct Side<'a, I> {
    decisions: &'a mut I,
    is_first: bool,
    /// The next one that triggered or faulted, and the instant that it counts to.
    next: Option<(i64, Decision)>,
    /// The latest time so far: who comes later with an earlier one counts to this instant, so that instants never go back.
    latest: i64,
    asked: bool,
}

impl<'a, I: Iterator<Item = Result<Decision, ResultsError>>> Side<'a, I> {
    fn new(decisions: &'a mut I, is_first: bool) -> Self {
        Self { decisions, is_first, next: None, latest: i64::MIN, asked: false }
    }

    fn peek(&mut self) -> Result<Option<i64>, WakesError> {
        if !self.asked {
            self.asked = true;
            // With `--all` a run has quiet wakes, too: they are as good as none.
            let speaks = |decision: &Decision| !decision.triggers.is_empty() || decision.fault.is_some();
            let next = self.decisions.find(|decision| decision.as_ref().map_or(true, speaks));
            let next = next.transpose().map_err(WakesError::Read)?;
            self.next = next.map(|decision| {
                self.latest = self.latest.max(decision.at_ns);
                (self.latest, decision)
            });
        }
        Ok(self.next.as_ref().map(|(instant, _)| *instant))
    }

    /// The wakes of `instant`, and whether any has another time.
    fn at(&mut self, instant: i64) -> Result<(Vec<Decision>, bool), WakesError> {
        let (mut wakes, mut is_late) = (Vec::new(), false);
        while self.peek()? == Some(instant) {
            if wakes.len() == AT_ONCE {
                return Err(WakesError::Crowded { first: self.is_first });
            }
            self.asked = false;
            if let Some((_, decision)) = self.next.take() {
                is_late |= decision.at_ns != instant;
                wakes.push(decision);
            }
        }
        Ok((wakes, is_late))
    }
}
