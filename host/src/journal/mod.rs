//! Builds the journal entry of each wake, from which the decision can be reproduced.
//! The format is `gleaner_journal`.

mod identity;

pub use identity::{IdentityError, LambdaIdentity};

use std::sync::Arc;

use gleaner_journal::{InputView, JournalEntry, LogDigest, WakeSource};
use gleaner_lambda::Decision;

use crate::api::data::{Topic, Wake};
use crate::api::trace::Trace;

/// Clock of a replay's journal.
pub const CLOCK_OF_DRIVE: &str = "log time of the drive";

/// Builds the entries of one lambda. It reuses its memory, so that a wake costs no allocation.
pub struct EntryBuilder {
    topics: Vec<(Arc<Topic>, Trace)>,
    /// The topic, and the position in its ring, of the sample that caused the wake.
    woken_by: Option<(usize, u64)>,
    entry: JournalEntry,
}

impl EntryBuilder {
    /// A builder that counts samples from now on.
    pub fn new(inputs: &[Arc<Topic>]) -> Self {
        let topics: Vec<_> =
            inputs.iter().map(|topic| (Arc::clone(topic), Trace::of(topic))).collect();
        let entry = JournalEntry {
            seen: vec![InputView::default(); topics.len()],
            ..JournalEntry::default()
        };
        Self { topics, woken_by: None, entry }
    }

    /// Notes the state of the inputs; call it before each wake.
    pub fn begin(&mut self, wake: &Wake) {
        self.entry.at_ns = wake.at_ns();
        self.woken_by = None;
        match wake {
            Wake::Event(sample) => {
                let meta = sample.meta();
                self.entry.cause = WakeSource::Sample { writer: meta.writer.0, seq: meta.seq };
                let input =
                    self.topics.iter().position(|(topic, _)| Arc::ptr_eq(topic, sample.topic()));
                self.woken_by = input.zip(sample.position());
            }
            Wake::Tick(tick) => self.entry.cause = WakeSource::Tick { missed: tick.missed },
        }
        for (index, ((topic, trace), seen)) in
            self.topics.iter_mut().zip(&mut self.entry.seen).enumerate()
        {
            let woken_by =
                self.woken_by.filter(|(input, _)| *input == index).map(|(_, position)| position);
            let sample = if let Wake::Event(sample) = wake { Some(sample.stored()) } else { None };
            trace.begin(topic, woken_by.zip(sample), seen);
        }
    }

    /// The inputs as of the last call of [`EntryBuilder::begin`].
    pub fn seen(&self) -> &[InputView] {
        &self.entry.seen
    }

    /// Skips the samples since the previous wake.
    pub fn skip(&mut self) {
        for ((topic, trace), seen) in self.topics.iter_mut().zip(&mut self.entry.seen) {
            trace.begin(topic, None, seen);
        }
    }

    /// Completes the entry of a wake that led to `decision` and logged `log`; call it after the
    /// wake.
    pub fn end(&mut self, decision: &Decision, log: LogDigest) -> &JournalEntry {
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
