//! What is written down of each wake, so that the decision can be made again and compared. The
//! format is `gleaner_journal`; here it is filled in.

mod identity;

pub use identity::{Identity, IdentityError};

use std::sync::Arc;

use gleaner_journal::{Entry, Said, Seen, Woken};
use gleaner_lambda::Decision;

use crate::api::data::{Topic, Wake};
use crate::api::trace::Trace;

/// What the times of a replay's journal are.
pub const CLOCK_OF_DRIVE: &str = "log time of the drive";
/// What the times of a live journal are.
pub const CLOCK_OF_VEHICLE: &str = "CLOCK_MONOTONIC of the vehicle, set to the time of day once";

/// Follows a lambda from wake to wake. It reuses its memory, so that a wake costs no allocation.
pub struct Scribe {
    topics: Vec<(Arc<Topic>, Trace)>,
    /// The topic, and the position in its ring, of the sample that caused the wake.
    woken_by: Option<(usize, u64)>,
    entry: Entry,
}

impl Scribe {
    /// Begins with what is in the rings now.
    pub fn new(inputs: &[Arc<Topic>]) -> Self {
        let topics: Vec<_> =
            inputs.iter().map(|topic| (Arc::clone(topic), Trace::of(topic))).collect();
        let entry = Entry {
            at_ns: 0,
            cause: Woken::Tick { missed: 0 },
            seen: vec![Seen::default(); topics.len()],
            triggers: Vec::new(),
            fault: None,
            fuel: None,
            log: Said::default(),
        };
        Self { topics, woken_by: None, entry }
    }

    /// Before a wake.
    pub fn begin(&mut self, wake: &Wake) {
        self.entry.at_ns = wake.at_ns();
        self.woken_by = None;
        match wake {
            Wake::Event(sample) => {
                let meta = sample.meta();
                self.entry.cause = Woken::Sample { writer: meta.writer.0, seq: meta.seq };
                let input =
                    self.topics.iter().position(|(topic, _)| Arc::ptr_eq(topic, sample.topic()));
                self.woken_by = input.zip(sample.position());
            }
            Wake::Tick(tick) => self.entry.cause = Woken::Tick { missed: tick.missed },
        }
        for (index, ((topic, trace), seen)) in
            self.topics.iter_mut().zip(&mut self.entry.seen).enumerate()
        {
            let woken_by =
                self.woken_by.filter(|(input, _)| *input == index).map(|(_, position)| position);
            let sample = if let Wake::Event(sample) = wake { Some(sample.meta()) } else { None };
            trace.begin(topic, woken_by.zip(sample), seen);
        }
    }

    /// Forgets what came since the wake before.
    pub fn skip(&mut self) {
        for ((topic, trace), seen) in self.topics.iter_mut().zip(&mut self.entry.seen) {
            trace.begin(topic, None, seen);
        }
    }

    /// After a wake that led to `decision` and said `log`.
    pub fn end(&mut self, decision: &Decision, log: Said) -> &Entry {
        for (index, ((topic, trace), seen)) in
            self.topics.iter().zip(&mut self.entry.seen).enumerate()
        {
            let woken_by =
                self.woken_by.filter(|(input, _)| *input == index).map(|(_, position)| position);
            trace.end(topic, woken_by, seen);
        }
        self.entry.triggers.clone_from(&decision.triggers);
        self.entry.fault.clone_from(&decision.fault);
        self.entry.fuel = decision.fuel;
        self.entry.log = log;
        &self.entry
    }
}
