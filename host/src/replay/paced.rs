//! A drive that hands out samples input by input, as a journal says, instead of by time alone.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_transport::message::Definitions;
use gleaner_transport::replay::{Replay, ReplayError};
use gleaner_transport::{
    DiscoveredTopic, SampleMeta, Sink, Subscription, TopicSpec, Transport, TransportError, Verdict,
};

/// Most bytes that wait until their input's turn. Inputs take turns as they did in the drive, so that few wait.
const WAITING_BYTES: usize = 256 << 20;

/// Why the next sample of an input cannot be had.
#[derive(Debug, thiserror::Error)]
pub(super) enum PaceError {
    #[error(transparent)]
    Drive(#[from] ReplayError),
    #[error("more than {WAITING_BYTES} bytes of other inputs come before it")]
    TooFarAhead,
}

/// A drive with a lane for each subscription.
pub(super) struct Paced {
    drive: Replay,
    lanes: Vec<Lane>,
    waiting_bytes: Arc<AtomicUsize>,
    ended: bool,
}

struct Lane {
    /// Where samples go when it is their turn.
    sink: Arc<dyn Sink>,
    waiting: Arc<Waiting>,
}

/// Samples of one lane that were read and not delivered.
#[derive(Default)]
struct Waiting {
    samples: Mutex<VecDeque<(SampleMeta, Vec<u8>)>>,
    /// Of all lanes.
    bytes: Arc<AtomicUsize>,
}

impl Waiting {
    fn lock(&self) -> MutexGuard<'_, VecDeque<(SampleMeta, Vec<u8>)>> {
        self.samples.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn pop(&self) -> Option<(SampleMeta, Vec<u8>)> {
        let (meta, cdr) = self.lock().pop_front()?;
        self.bytes.fetch_sub(cdr.len(), Ordering::Relaxed);
        Some((meta, cdr))
    }
}

impl Sink for Waiting {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        self.bytes.fetch_add(cdr.len(), Ordering::Relaxed);
        self.lock().push_back((*meta, cdr.to_vec()));
        Verdict::Taken
    }
}

impl Paced {
    pub(super) fn new(drive: Replay) -> Self {
        Self { drive, lanes: Vec::new(), waiting_bytes: Arc::default(), ended: false }
    }

    /// Delivers the next sample of `lane`; none at the end of the drive.
    pub(super) fn deliver(&mut self, lane: usize) -> Result<Option<Verdict>, PaceError> {
        if !self.reach(lane, 1)? {
            return Ok(None);
        }
        let Lane { sink, waiting } = &self.lanes[lane];
        Ok(waiting.pop().map(|(meta, cdr)| sink.deliver(&meta, &cdr)))
    }

    /// How many samples of `lane` come up to and with the one that `is_wanted`; none if there is none up to `until_ns`.
    pub(super) fn ahead(
        &mut self,
        lane: usize,
        until_ns: i64,
        is_wanted: impl Fn(&SampleMeta) -> bool,
    ) -> Result<Option<usize>, PaceError> {
        let mut n = 0;
        while self.reach(lane, n + 1)? {
            let meta = self.lanes[lane].waiting.lock()[n].0;
            if is_wanted(&meta) {
                return Ok(Some(n + 1));
            }
            if meta.at_ns > until_ns {
                break;
            }
            n += 1;
        }
        Ok(None)
    }

    /// Reads on until `n` samples of `lane` wait; false if the drive ends before.
    fn reach(&mut self, lane: usize, n: usize) -> Result<bool, PaceError> {
        let waits = |lane: &Lane| lane.waiting.lock().len();
        while waits(&self.lanes[lane]) < n {
            if self.ended {
                return Ok(false);
            }
            match self.drive.step() {
                Ok(Some(_)) => {}
                Ok(None) => self.ended = true,
                Err(error) => {
                    self.ended = true;
                    return Err(error.into());
                }
            }
            if self.waiting_bytes.load(Ordering::Relaxed) > WAITING_BYTES {
                return Err(PaceError::TooFarAhead);
            }
        }
        Ok(true)
    }

    pub(super) fn start_ns(&self) -> i64 {
        self.drive.start_ns().unwrap_or(0)
    }
}

impl Transport for Paced {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.drive.topics()
    }

    fn subscribe(&mut self, spec: &TopicSpec, sink: Arc<dyn Sink>) -> Result<Subscription, TransportError> {
        let waiting = Arc::new(Waiting { samples: Mutex::default(), bytes: self.waiting_bytes.clone() });
        let subscription = self.drive.subscribe(spec, waiting.clone())?;
        self.lanes.push(Lane { sink, waiting });
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.drive.definitions(topic)
    }
}
