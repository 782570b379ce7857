//! The spool of a lambda, for a daemon that runs it for months.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_lambda::{Decision, LogLine};
use gleaner_protocol::{ItemLosses, ProcessOrigin, SpooledRecord};
use gleaner_spool::{BootId, SpoolConfig, SpoolError, SpoolTime, SpoolWriter};

use super::sink::{ProcessResults, ResultSink};

/// Budget of a spool, unless the starter sets another one.
pub(crate) const BUDGET: ByteSize = ByteSize::mib(64);

/// Longest time that records wait. Decisions with a trigger or a fault do not wait.
const FLUSH: Duration = Duration::from_millis(200);

/// Bytes that wait at most, in a spool whose queue holds four times as much.
const PENDING_MAX: u64 = 64 << 10;

/// Time to wait for another writer: the shim of the process before may be about to end.
const BUSY: Duration = Duration::from_secs(5);

/// Shortest time between two records of losses, unless writing has failed in between. A lambda that
/// sends invalid items for months must not fill its spool with their counts.
const LOSSES: Duration = Duration::from_secs(10);

pub(crate) struct ResultSpool {
    writer: SpoolWriter,
    /// Bytes at which waiting records are written.
    pending_max: usize,
    too_long: u64,
    /// The losses in the last record of losses, and the time when it was added.
    recorded: (ItemLosses, Option<Instant>),
    /// Set if a commit failed since the last record of losses.
    has_failed: bool,
}

impl ResultSpool {
    /// Opens or creates the spool in `folder`, and adds the start of a process of `origin`.
    pub(crate) fn open(
        folder: &Path,
        origin: &ProcessOrigin,
        budget: ByteSize,
    ) -> Result<Self, Failure> {
        let cannot = || format!("cannot open the spool `{}`", folder.display());
        let boot = BootId::current()
            .map_err(|error| Failure::caused_by(Exit::Internal, cannot(), &error))?;
        let config = SpoolConfig { stream: origin.lambda.clone(), boot, budget };
        let since = Instant::now();
        let writer = loop {
            match SpoolWriter::open(folder, config.clone()) {
                Err(SpoolError::Busy { .. }) if since.elapsed() < BUSY => {
                    thread::sleep(Duration::from_millis(50));
                }
                opened => {
                    break opened.map_err(|error| Failure::because(cannot(), &error))?;
                }
            }
        };
        // A sixty-fourth of the budget is a quarter of the queue, and a record has half of it at
        // most. So the queue is full only if a commit has failed.
        let pending_max = usize::try_from(PENDING_MAX.min(budget.bytes() / 64))
            .expect("it is at most `PENDING_MAX`");
        let recorded = (ItemLosses::default(), None);
        let mut spool = Self { writer, pending_max, too_long: 0, recorded, has_failed: false };
        spool.append(&SpooledRecord::Started(origin.started(std::process::id())))?;
        Ok(spool)
    }

    /// Adds a record, or a note of its size if it is too long.
    fn append(&mut self, record: &SpooledRecord) -> Result<(), Failure> {
        let appended =
            match self.writer.append(record.kind(), SpoolTime::now(), &record.to_payload()) {
                Err(SpoolError::TooLong { bytes, most, .. }) => {
                    self.too_long += 1;
                    let omitted = SpooledRecord::Omitted(record.omitted(bytes, most));
                    self.writer.append(omitted.kind(), SpoolTime::now(), &omitted.to_payload())
                }
                appended => appended,
            };
        appended?;
        Ok(())
    }

    fn commit(&mut self) -> Result<(), Failure> {
        let committed = self.writer.commit();
        self.has_failed |= committed.is_err();
        committed?;
        Ok(())
    }

    /// Adds the losses if there are more than in the last record of them.
    fn append_losses(&mut self, invalid: u64) -> Result<(), Failure> {
        let refused = self.writer.status().refused;
        let losses = ItemLosses { invalid, refused, too_long: self.too_long };
        if losses != self.recorded.0 {
            self.append(&SpooledRecord::Lost(losses))?;
            self.recorded = (losses, Some(Instant::now()));
        }
        Ok(())
    }
}

impl ResultSink for ResultSpool {
    fn interval(&self) -> Duration {
        FLUSH
    }

    fn begin(&mut self) -> Result<(), Failure> {
        Ok(())
    }

    fn decision(&mut self, decision: Box<Decision>) -> Result<(), Failure> {
        self.append(&SpooledRecord::Decision(decision))
    }

    fn log(&mut self, line: LogLine) -> Result<(), Failure> {
        self.append(&SpooledRecord::Log(line))
    }

    fn has_pending(&self) -> bool {
        self.writer.queued_bytes() > 0
    }

    fn is_due(&self) -> bool {
        self.writer.queued_bytes() >= self.pending_max
    }

    fn flush(&mut self, invalid: u64) -> Result<(), Failure> {
        self.commit()?;
        if self.has_failed || self.recorded.1.is_none_or(|at| at.elapsed() >= LOSSES) {
            self.append_losses(invalid)?;
            self.commit()?;
            self.has_failed = false;
        }
        Ok(())
    }

    fn lost(&self) -> u64 {
        self.writer.status().refused + self.too_long
    }

    fn finish(mut self: Box<Self>, end: ProcessResults<'_>) -> Result<(), Failure> {
        if let Some(summary) = end.summary {
            self.append(&SpooledRecord::Summary(summary))?;
        }
        self.append_losses(end.invalid)?;
        self.append(&SpooledRecord::Ended(end.record.clone()))?;
        self.commit()
    }
}
