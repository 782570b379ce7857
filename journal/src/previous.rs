//! The previous wake, relative to which a wake is encoded. Encoder and decoder share these rules.

use crate::entry::{JournalEntry, WakeSource};

/// The values of the previous wake that the encoding of the next one refers to.
pub(crate) struct PreviousWake {
    /// Stamp of the previous wake; `None` at the start of a block.
    pub(crate) at_ns: Option<i64>,
    /// Time between the last two wakes, 0 if there were fewer: lambdas wake at a fairly even rate.
    pub(crate) step_ns: i64,
    /// Writer and sequence number of the last sample that caused a wake.
    pub(crate) woken_by: ([u8; 16], u64),
    /// Fuel of the last wake that had some.
    pub(crate) fuel: u64,
    pub(crate) inputs: Vec<PreviousInput>,
}

#[derive(Clone, Copy, Default)]
pub(crate) struct PreviousInput {
    pub(crate) newest: Option<([u8; 16], u64)>,
    pub(crate) reach: u64,
}

impl PreviousInput {
    /// Returns the expected newest sample after `new` further ones of the same writer.
    pub(crate) fn expected_newest(&self, new: u64) -> Option<([u8; 16], u64)> {
        self.newest.map(|(writer, seq)| (writer, seq.wrapping_add(new)))
    }
}

impl PreviousWake {
    pub(crate) fn none(inputs: usize) -> Self {
        let inputs = vec![PreviousInput::default(); inputs];
        // With this, the first expected number is 0.
        Self { at_ns: None, step_ns: 0, woken_by: ([0; 16], u64::MAX), fuel: 0, inputs }
    }

    pub(crate) fn reset(&mut self) {
        let mut inputs = std::mem::take(&mut self.inputs);
        inputs.fill(PreviousInput::default());
        *self = Self { inputs, ..Self::none(0) };
    }

    /// Returns the expected stamp of the next wake, at an even rate.
    pub(crate) fn expected_at_ns(&self) -> i64 {
        self.at_ns.unwrap_or(0).wrapping_add(self.step_ns)
    }

    /// Returns the expected number of the next sample that causes a wake: the one after the last,
    /// or 0 for another writer.
    pub(crate) fn expected_seq(&self, same_writer: bool) -> u64 {
        if same_writer { self.woken_by.1.wrapping_add(1) } else { 0 }
    }

    /// Replaces the previous wake by `entry`, after it was written or read.
    pub(crate) fn update(&mut self, entry: &JournalEntry) {
        self.step_ns = self.at_ns.map_or(0, |before| entry.at_ns.wrapping_sub(before));
        self.at_ns = Some(entry.at_ns);
        if let WakeSource::Sample { writer, seq } = entry.cause {
            self.woken_by = (writer, seq);
        }
        self.fuel = entry.fuel.unwrap_or(self.fuel);
        for (before, seen) in self.inputs.iter_mut().zip(&entry.seen) {
            *before = PreviousInput { newest: seen.newest, reach: seen.reach };
        }
    }
}

/// Bits of the first byte of a wake.
pub(crate) mod flag {
    /// The clock woke the lambda, not a sample.
    pub(crate) const TICK: u8 = 1;
    /// The writer of the waking sample differs from the previous one, and follows.
    pub(crate) const WRITER: u8 = 1 << 1;
    /// The waking sample does not have the expected number, or ticks were missed: a number follows.
    pub(crate) const NUMBER: u8 = 1 << 2;
    pub(crate) const FUEL: u8 = 1 << 3;
    pub(crate) const TRIGGERS: u8 = 1 << 4;
    pub(crate) const FAULT: u8 = 1 << 5;
    pub(crate) const LOG: u8 = 1 << 6;
    pub(crate) const RESERVED: u8 = 1 << 7;
}

/// Bits of the first byte of an input.
pub(crate) mod seen {
    /// Number of new samples; if all bits are set, the following number is added.
    pub(crate) const NEW: u8 = 31;
    /// The newest sample is not the expected one, and follows.
    pub(crate) const NEWEST: u8 = 1 << 5;
    /// The reach differs from the previous one, and follows.
    pub(crate) const REACH: u8 = 1 << 6;
    /// A digest of the new samples follows.
    pub(crate) const DIGEST: u8 = 1 << 7;
}

/// Forms of a newest sample that is not the expected one.
pub(crate) mod newest {
    pub(crate) const NONE: u8 = 0;
    /// The same writer as before: its number relative to the expected one follows.
    pub(crate) const SAME_WRITER: u8 = 1;
    /// Another writer: it follows, and its number.
    pub(crate) const OTHER_WRITER: u8 = 2;
}

/// Bits of the first byte of a trigger, besides its kind.
pub(crate) const TRIGGER_SCORE: u8 = 1 << 2;

/// Bits of the first byte of a fault, besides its kind.
pub(crate) const FAULT_USED: u8 = 1 << 3;
pub(crate) const FAULT_ALLOWED: u8 = 1 << 4;
