//! Counts of this process since its start, for `/metrics`. They are one static value, as the parts
//! of the program that count share nothing else.

use std::sync::atomic::{AtomicU64, Ordering};

pub(crate) static COUNTS: ProcessCounts = ProcessCounts {
    records: Count::new(),
    refused_links: Count::new(),
    writes: Count::new(),
    write_us: Count::new(),
    answers: [const { Count::new() }; 600],
};

pub(crate) struct ProcessCounts {
    /// Records that were acknowledged.
    pub(crate) records: Count,
    /// Connections of vehicles that were ended with an error.
    pub(crate) refused_links: Count,
    /// Transactions of what vehicles send, and their time in µs.
    pub(crate) writes: Count,
    pub(crate) write_us: Count,
    /// Answers of both listeners by their HTTP status.
    pub(crate) answers: [Count; 600],
}

impl ProcessCounts {
    pub(crate) fn answered(&self, status: u16) {
        if let Some(count) = self.answers.get(usize::from(status)) {
            count.add(1);
        }
    }
}

pub(crate) struct Count(AtomicU64);

impl Count {
    const fn new() -> Self {
        Self(AtomicU64::new(0))
    }

    pub(crate) fn add(&self, more: u64) {
        self.0.fetch_add(more, Ordering::Relaxed);
    }

    pub(crate) fn read(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
