//! A drive that hands out samples input by input, as a journal says, instead of by time alone.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_drives::{Replay, ReplayError};
use gleaner_messages::Definitions;
use gleaner_transport::{
    DiscoveredTopic, SampleMeta, Sink, Subscription, TopicSpec, Transport, TransportError, Verdict,
};

/// Most bytes that wait until their input's turn. Inputs take turns as they did in the drive, so
/// that few wait.
const WAITING_BYTES: usize = 256 << 20;

/// What a sample that waits takes beside its bytes: a clip may hold millions of empty ones.
const WAITING_COST: usize = 128;

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
    lanes: Vec<Arc<Gate>>,
    waiting_bytes: Arc<AtomicUsize>,
    ended: bool,
}

/// One lane's way from the drive to its sink. The drive fills it and the comparison empties it, on
/// one thread.
struct Gate {
    /// Where samples go when it is their turn.
    sink: Arc<dyn Sink>,
    state: Mutex<State>,
    /// Bytes that wait, of all lanes.
    waiting_bytes: Arc<AtomicUsize>,
}

/// A sample, or the length of one that is too big.
enum Held {
    Whole(Vec<u8>),
    TooBig(usize),
}

#[derive(Default)]
struct State {
    /// How many samples may pass.
    owed: u64,
    /// Samples that came before their turn.
    waiting: VecDeque<(SampleMeta, Held)>,
}

impl Held {
    fn cost(&self) -> usize {
        match self {
            Self::Whole(cdr) => WAITING_COST + cdr.len(),
            Self::TooBig(_) => WAITING_COST,
        }
    }
}

impl Gate {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait(&self, state: &mut State, meta: SampleMeta, held: Held) {
        self.waiting_bytes.fetch_add(held.cost(), Ordering::Relaxed);
        state.waiting.push_back((meta, held));
    }

    /// Lets `n` more samples pass: those that wait at once.
    fn owe(&self, n: u64) {
        let mut state = self.lock();
        state.owed = state.owed.saturating_add(n);
        while state.owed > 0 {
            let Some((meta, held)) = state.waiting.pop_front() else { break };
            state.owed -= 1;
            self.waiting_bytes.fetch_sub(held.cost(), Ordering::Relaxed);
            match held {
                Held::Whole(cdr) => drop(self.sink.deliver(&meta, &cdr)),
                Held::TooBig(len) => self.sink.too_big(&meta, len),
            }
        }
    }
}

impl Sink for Gate {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        let mut state = self.lock();
        if state.owed > 0 {
            state.owed -= 1;
            return self.sink.deliver(meta, cdr);
        }
        self.wait(&mut state, *meta, Held::Whole(cdr.to_vec()));
        Verdict::Taken
    }

    fn too_big(&self, meta: &SampleMeta, len: usize) {
        let mut state = self.lock();
        if state.owed > 0 {
            state.owed -= 1;
            return self.sink.too_big(meta, len);
        }
        self.wait(&mut state, *meta, Held::TooBig(len));
    }
}

impl Paced {
    pub(super) fn new(drive: Replay) -> Self {
        Self { drive, lanes: Vec::new(), waiting_bytes: Arc::default(), ended: false }
    }

    /// Delivers the next so many samples of each lane. Fewer pass where the drive ends before.
    pub(super) fn deliver(&mut self, owed: impl Iterator<Item = u64>) -> Result<(), PaceError> {
        self.lanes.iter().zip(owed).for_each(|(lane, n)| lane.owe(n));
        while self.lanes.iter().any(|lane| lane.lock().owed > 0) && self.step()? {}
        self.lanes.iter().for_each(|lane| lane.lock().owed = 0);
        Ok(())
    }

    /// How many samples of `lane` come up to and with the one that `is_wanted`; none if there is
    /// none up to `until_ns`.
    pub(super) fn ahead(
        &mut self,
        lane: usize,
        until_ns: i64,
        is_wanted: impl Fn(&SampleMeta) -> bool,
    ) -> Result<Option<u64>, PaceError> {
        let mut n = 0;
        loop {
            let next = self.lanes[lane].lock().waiting.get(n).map(|(meta, _)| *meta);
            match next {
                Some(meta) if is_wanted(&meta) => return Ok(Some(n as u64 + 1)),
                Some(meta) if meta.at_ns > until_ns => return Ok(None),
                Some(_) => n += 1,
                None if self.step()? => {}
                None => return Ok(None),
            }
        }
    }

    /// Reads one sample; false at the end.
    fn step(&mut self) -> Result<bool, PaceError> {
        if self.ended {
            return Ok(false);
        }
        let step = self.drive.step();
        self.ended = !matches!(step, Ok(Some(_)));
        if step?.is_some() && self.waiting_bytes.load(Ordering::Relaxed) > WAITING_BYTES {
            return Err(PaceError::TooFarAhead);
        }
        Ok(!self.ended)
    }

    pub(super) fn start_ns(&self) -> i64 {
        self.drive.start_ns().unwrap_or(0)
    }
}

impl Transport for Paced {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.drive.topics()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let gate = Arc::new(Gate {
            sink,
            state: Mutex::default(),
            waiting_bytes: self.waiting_bytes.clone(),
        });
        let subscription = self.drive.subscribe(spec, gate.clone())?;
        self.lanes.push(gate);
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.drive.definitions(topic)
    }
}
