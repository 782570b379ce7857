//! A drive that delivers samples in lockstep with a journal: so many of each input, instead of in
//! the order of time.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_drives::{Replay, ReplayError};
use gleaner_messages::Definitions;
use gleaner_messages::transport::{
    Delivery, DiscoveredTopic, SampleMeta, Sink, Subscription, TopicSpec, Transport, TransportError,
};

/// Upper bound of the bytes that wait for their input's turn. Inputs take turns as they did in the
/// drive, so that few wait.
const WAITING_BYTES: usize = 256 << 20;

/// Overhead of a waiting sample in bytes: a clip may hold millions of empty samples.
const WAITING_COST: usize = 128;

/// An error before the next sample of an input.
#[derive(Debug, thiserror::Error)]
pub(super) enum LockstepError {
    #[error(transparent)]
    Drive(#[from] ReplayError),
    #[error("more than {WAITING_BYTES} bytes of other inputs precede the next sample")]
    TooFarAhead,
}

/// A drive with a queue for each subscription.
pub(super) struct LockstepDrive {
    drive: Replay,
    sinks: Vec<Arc<LockstepSink>>,
    waiting_bytes: Arc<AtomicUsize>,
    ended: bool,
}

/// The queue from the drive to the sink of one subscription. Both ends run on one thread.
struct LockstepSink {
    /// Receives samples when it is their turn.
    sink: Arc<dyn Sink>,
    state: Mutex<SinkState>,
    /// Waiting bytes of all subscriptions.
    waiting_bytes: Arc<AtomicUsize>,
}

/// A waiting sample, or the length of one that is too big.
enum WaitingSample {
    Whole(Vec<u8>),
    TooBig(usize),
}

#[derive(Default)]
struct SinkState {
    /// Number of samples that may pass.
    owed: u64,
    /// Samples that arrived before their turn.
    waiting: VecDeque<(SampleMeta, WaitingSample)>,
}

impl WaitingSample {
    fn cost(&self) -> usize {
        match self {
            Self::Whole(cdr) => WAITING_COST + cdr.len(),
            Self::TooBig(_) => WAITING_COST,
        }
    }
}

impl LockstepSink {
    fn lock(&self) -> MutexGuard<'_, SinkState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait(&self, state: &mut SinkState, meta: SampleMeta, held: WaitingSample) {
        self.waiting_bytes.fetch_add(held.cost(), Ordering::Relaxed);
        state.waiting.push_back((meta, held));
    }

    /// Lets `n` more samples pass; waiting samples pass at once.
    fn owe(&self, n: u64) {
        let mut state = self.lock();
        state.owed = state.owed.saturating_add(n);
        while state.owed > 0 {
            let Some((meta, held)) = state.waiting.pop_front() else { break };
            state.owed -= 1;
            self.waiting_bytes.fetch_sub(held.cost(), Ordering::Relaxed);
            match held {
                WaitingSample::Whole(cdr) => drop(self.sink.deliver(&meta, &cdr)),
                WaitingSample::TooBig(len) => self.sink.too_big(&meta, len),
            }
        }
    }
}

impl Sink for LockstepSink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        // A clip has it beside the samples that the lambda saw.
        if meta.is_latched {
            return Delivery::Taken;
        }
        let mut state = self.lock();
        if state.owed > 0 {
            state.owed -= 1;
            return self.sink.deliver(meta, cdr);
        }
        self.wait(&mut state, *meta, WaitingSample::Whole(cdr.to_vec()));
        Delivery::Taken
    }

    fn too_big(&self, meta: &SampleMeta, len: usize) {
        let mut state = self.lock();
        if state.owed > 0 {
            state.owed -= 1;
            return self.sink.too_big(meta, len);
        }
        self.wait(&mut state, *meta, WaitingSample::TooBig(len));
    }
}

impl LockstepDrive {
    pub(super) fn new(drive: Replay) -> Self {
        Self { drive, sinks: Vec::new(), waiting_bytes: Arc::default(), ended: false }
    }

    /// Delivers the next `owed` samples of each subscription, or fewer if the drive ends.
    pub(super) fn deliver(&mut self, owed: impl Iterator<Item = u64>) -> Result<(), LockstepError> {
        self.sinks.iter().zip(owed).for_each(|(sink, n)| sink.owe(n));
        while self.sinks.iter().any(|sink| sink.lock().owed > 0) && self.step()? {}
        self.sinks.iter().for_each(|sink| sink.lock().owed = 0);
        Ok(())
    }

    /// Drops the next `unseen` samples of each subscription, as far as they were looked at.
    pub(super) fn discard(&mut self, unseen: impl Iterator<Item = u64>) {
        for (sink, n) in self.sinks.iter().zip(unseen) {
            let mut state = sink.lock();
            let n = usize::try_from(n).unwrap_or(usize::MAX).min(state.waiting.len());
            let bytes = state.waiting.drain(..n).map(|(_, held)| held.cost()).sum();
            sink.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
        }
    }

    /// Number of samples of subscription `sink` up to and including the first that `is_wanted`;
    /// `None` if there is none up to `until_ns`.
    pub(super) fn ahead(
        &mut self,
        sink: usize,
        until_ns: i64,
        is_wanted: impl Fn(&SampleMeta) -> bool,
    ) -> Result<Option<u64>, LockstepError> {
        let mut n = 0;
        loop {
            let next = self.sinks[sink].lock().waiting.get(n).map(|(meta, _)| *meta);
            match next {
                Some(meta) if is_wanted(&meta) => return Ok(Some(n as u64 + 1)),
                Some(meta) if meta.at_ns > until_ns => return Ok(None),
                Some(_) => n += 1,
                None if self.step()? => {}
                None => return Ok(None),
            }
        }
    }

    /// Reads one sample; returns false at the end.
    fn step(&mut self) -> Result<bool, LockstepError> {
        if self.ended {
            return Ok(false);
        }
        let step = self.drive.step();
        self.ended = !matches!(step, Ok(Some(_)));
        if step?.is_some() && self.waiting_bytes.load(Ordering::Relaxed) > WAITING_BYTES {
            return Err(LockstepError::TooFarAhead);
        }
        Ok(!self.ended)
    }

    pub(super) fn start_ns(&self) -> i64 {
        self.drive.start_ns().unwrap_or(0)
    }
}

impl Transport for LockstepDrive {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.drive.topics()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let queue = Arc::new(LockstepSink {
            sink,
            state: Mutex::default(),
            waiting_bytes: self.waiting_bytes.clone(),
        });
        let subscription = self.drive.subscribe(spec, queue.clone())?;
        self.sinks.push(queue);
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.drive.definitions(topic)
    }
}
