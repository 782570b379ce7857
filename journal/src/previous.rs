//! What a wake is written relative to: the wake before it. Writer and reader follow the same rules,
//! which stand here.

use super::entry::{JournalEntry, WakeSource};

/// The wake before, as far as the next one is written relative to it.
pub(super) struct Before {
    /// Stamp of the wake before; `None` at the begin of a block.
    pub(super) at_ns: Option<i64>,
    /// Time between the two wakes before, 0 if there were none: lambdas are woken at a fairly even
    /// rate.
    pub(super) step_ns: i64,
    /// Writer and number of the sample that caused a wake last.
    pub(super) woken_by: ([u8; 16], u64),
    /// Fuel of the wake before that had some.
    pub(super) fuel: u64,
    pub(super) inputs: Vec<InputBefore>,
}

/// One input in the wake before.
#[derive(Clone, Copy, Default)]
pub(super) struct InputBefore {
    pub(super) newest: Option<([u8; 16], u64)>,
    pub(super) reach: u64,
}

impl InputBefore {
    /// The newest sample after `new` further ones of the same writer.
    pub(super) fn expected_newest(&self, new: u64) -> Option<([u8; 16], u64)> {
        self.newest.map(|(writer, seq)| (writer, seq.wrapping_add(new)))
    }
}

impl Before {
    pub(super) fn nothing(inputs: usize) -> Self {
        let inputs = vec![InputBefore::default(); inputs];
        // So that the first number that is expected is 0.
        Self { at_ns: None, step_ns: 0, woken_by: ([0; 16], u64::MAX), fuel: 0, inputs }
    }

    pub(super) fn forget(&mut self) {
        let mut inputs = std::mem::take(&mut self.inputs);
        inputs.fill(InputBefore::default());
        *self = Self { inputs, ..Self::nothing(0) };
    }

    /// The stamp of the next wake, if it comes as long after the one before as that after its own.
    pub(super) fn expected_at_ns(&self) -> i64 {
        self.at_ns.unwrap_or(0).wrapping_add(self.step_ns)
    }

    /// The number of the next sample that causes a wake: the one after the last, or 0 if it is of
    /// another writer.
    pub(super) fn expected_seq(&self, same_writer: bool) -> u64 {
        if same_writer { self.woken_by.1.wrapping_add(1) } else { 0 }
    }

    /// `entry` was written or read.
    pub(super) fn note(&mut self, entry: &JournalEntry) {
        self.step_ns = self.at_ns.map_or(0, |before| entry.at_ns.wrapping_sub(before));
        self.at_ns = Some(entry.at_ns);
        if let WakeSource::Sample { writer, seq } = entry.cause {
            self.woken_by = (writer, seq);
        }
        self.fuel = entry.fuel.unwrap_or(self.fuel);
        for (before, seen) in self.inputs.iter_mut().zip(&entry.seen) {
            *before = InputBefore { newest: seen.newest, reach: seen.reach };
        }
    }
}

/// Bits of the first byte of a wake.
pub(super) mod flag {
    /// The clock woke the lambda, not a sample.
    pub(crate) const TICK: u8 = 1;
    /// The writer of the waking sample is another than before, and follows.
    pub(crate) const WRITER: u8 = 1 << 1;
    /// The waking sample's number is not the expected one, or ticks were missed: a number follows.
    pub(crate) const NUMBER: u8 = 1 << 2;
    /// The wake has fuel.
    pub(crate) const FUEL: u8 = 1 << 3;
    /// The wake has triggers.
    pub(crate) const TRIGGERS: u8 = 1 << 4;
    /// The wake ended in a fault.
    pub(crate) const FAULT: u8 = 1 << 5;
    /// The wake wrote to its log.
    pub(crate) const LOG: u8 = 1 << 6;
    /// Has no meaning yet.
    pub(crate) const RESERVED: u8 = 1 << 7;
}

/// Bits of the first byte of an input.
pub(super) mod seen {
    /// How many samples are new; if it is this, so many and the number that follows.
    pub(crate) const NEW: u8 = 31;
    /// The newest sample is not the expected one, and follows.
    pub(crate) const NEWEST: u8 = 1 << 5;
    /// The reach is another than before, and follows.
    pub(crate) const REACH: u8 = 1 << 6;
    /// A digest of the new samples follows.
    pub(crate) const DIGEST: u8 = 1 << 7;
}

/// How a newest sample that is not the expected one is given.
pub(super) mod newest {
    /// There is none.
    pub(crate) const NONE: u8 = 0;
    /// Of the same writer as before: its number relative to the expected one.
    pub(crate) const SAME_WRITER: u8 = 1;
    /// Its writer, and its number.
    pub(crate) const OTHER_WRITER: u8 = 2;
}

/// Bits of the first byte of a trigger, beside its kind.
pub(super) const TRIGGER_SCORE: u8 = 1 << 2;

/// Bits of the first byte of a fault, beside its kind.
pub(super) const FAULT_USED: u8 = 1 << 3;
pub(super) const FAULT_ALLOWED: u8 = 1 << 4;
