//! The state that all simulated vehicles share: what they are to do, and what they have measured.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use rustix::process::{Resource, getrlimit};
use tokio::sync::{Semaphore, watch};
use tokio::time::{Instant, sleep};

/// Number of open files for everything but the vehicles.
const OTHER_FILES: usize = 500;
/// Number of errors that are printed.
const SHOWN: usize = 10;

/// Frames that each vehicle sends.
#[derive(Debug, Clone, Copy, Default)]
pub struct FleetLoad {
    /// Interval of reports, and of batches of records; without one, the vehicle is idle.
    pub interval: Option<Duration>,
    /// Number of records in a batch.
    pub records: u64,
}

/// The shared state.
pub struct Simulation {
    /// The cloud's address for vehicles.
    pub address: SocketAddr,
    pub begun: Instant,
    pub load: watch::Sender<FleetLoad>,
    /// Longest pause between attempts to connect.
    pub pause_max: Duration,
    /// True while ends of connections are no errors.
    pub is_restarting: AtomicBool,
    pub connected: AtomicUsize,
    pub reports: AtomicU64,
    /// Connections for files at a time: as many as the process may open beside those for frames.
    pub files: Semaphore,
    /// Release that is awaited.
    pub release: AtomicU64,
    errors: Counted,
    losses: Counted,
    acknowledged_ms: Mutex<Vec<f64>>,
    /// The number after the last acknowledged record, by vehicle.
    ends: Mutex<HashMap<String, u64>>,
    reconnected_s: Mutex<Vec<f64>>,
    applied_s: Mutex<(Option<Instant>, Vec<f64>)>,
    /// The envelopes that the cloud wanted a vehicle to run, one after the other; empty for none.
    wanted: Mutex<HashMap<String, Vec<String>>>,
}

#[derive(Default)]
struct Counted(AtomicUsize);

impl Counted {
    fn add(&self, text: &str) {
        if self.0.fetch_add(1, Relaxed) < SHOWN {
            eprintln!("error: {text}");
        }
    }
}

impl Simulation {
    pub fn new(address: SocketAddr, pause_max: Duration, vehicles: usize) -> Self {
        let open_files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
        let open_files = usize::try_from(open_files).unwrap_or(usize::MAX);
        let files = open_files.saturating_sub(vehicles + OTHER_FILES);
        Self {
            address,
            begun: Instant::now(),
            load: watch::Sender::new(FleetLoad::default()),
            pause_max,
            is_restarting: AtomicBool::new(false),
            connected: AtomicUsize::new(0),
            reports: AtomicU64::new(0),
            files: Semaphore::new(files.clamp(1, Semaphore::MAX_PERMITS)),
            release: AtomicU64::new(0),
            errors: Counted::default(),
            losses: Counted::default(),
            acknowledged_ms: Mutex::default(),
            ends: Mutex::default(),
            reconnected_s: Mutex::default(),
            applied_s: Mutex::default(),
            wanted: Mutex::default(),
        }
    }

    /// Counts an error.
    pub fn error(&self, text: String) {
        self.errors.add(&text);
    }

    /// Counts acknowledged records that are not stored, or stored more than once.
    pub fn loss(&self, text: String) {
        self.losses.add(&text);
    }

    pub fn errors(&self) -> f64 {
        self.errors.0.load(Relaxed) as f64
    }

    pub fn losses(&self) -> f64 {
        self.losses.0.load(Relaxed) as f64
    }

    /// Notes that the records of a vehicle before `end` were acknowledged, `after` they were sent.
    pub fn acknowledged(&self, vehicle: &str, end: u64, after: Duration) {
        push(&self.acknowledged_ms, after.as_secs_f64() * 1000.0);
        let mut ends = lock(&self.ends);
        match ends.get_mut(vehicle) {
            Some(before) => *before = end,
            None => drop(ends.insert(vehicle.to_owned(), end)),
        }
    }

    /// Returns the number after the last acknowledged record of a vehicle.
    pub fn end_of(&self, vehicle: &str) -> u64 {
        lock(&self.ends).get(vehicle).copied().unwrap_or(0)
    }

    /// Notes the envelope that the cloud wants a vehicle to run; empty for none.
    pub fn wants(&self, vehicle: &str, envelope: &str) {
        let mut wanted = lock(&self.wanted);
        let of_vehicle = wanted.entry(vehicle.to_owned()).or_default();
        if of_vehicle.last().map_or("", |last| last) != envelope {
            of_vehicle.push(envelope.to_owned());
        }
    }

    /// Returns the different envelopes that the cloud wanted a vehicle to run, one after the other.
    pub fn wanted_of(&self, vehicle: &str) -> Vec<String> {
        lock(&self.wanted).get(vehicle).cloned().unwrap_or_default()
    }

    /// Notes the time from the end of a connection to the next one.
    pub fn reconnected(&self, after: Duration) {
        push(&self.reconnected_s, after.as_secs_f64());
    }

    /// Begins to wait for a release.
    pub fn await_release(&self, release: u64) {
        self.release.store(release, Relaxed);
        *lock(&self.applied_s) = (Some(Instant::now()), Vec::new());
    }

    /// Notes that a vehicle has reported what it runs, of which `newest` is the highest release.
    pub fn applied(&self, newest: Option<u64>) {
        if newest != Some(self.release.load(Relaxed)) {
            return;
        }
        let (since, applied) = &mut *lock(&self.applied_s);
        if let Some(since) = since {
            applied.push(since.elapsed().as_secs_f64());
        }
    }

    /// Takes the times from a batch to its acknowledgement, in ms.
    pub fn take_acknowledged_ms(&self) -> Vec<f64> {
        std::mem::take(&mut lock(&self.acknowledged_ms))
    }

    /// Takes the times from the end of a connection to the next one, in s.
    pub fn take_reconnected_s(&self) -> Vec<f64> {
        std::mem::take(&mut lock(&self.reconnected_s))
    }

    /// Returns the times from a deployment to the reports of its release, in s.
    pub fn applied_s(&self) -> Vec<f64> {
        lock(&self.applied_s).1.clone()
    }

    /// Waits until a condition holds; returns the time, or `None` after `most`.
    pub async fn until(&self, most: Duration, holds: impl Fn(&Self) -> bool) -> Option<Duration> {
        let begun = Instant::now();
        while !holds(self) {
            if begun.elapsed() > most {
                return None;
            }
            sleep(Duration::from_millis(10)).await;
        }
        Some(begun.elapsed())
    }
}

fn lock<T>(value: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    value.lock().unwrap_or_else(PoisonError::into_inner)
}

fn push(values: &Mutex<Vec<f64>>, value: f64) {
    lock(values).push(value);
}

/// Returns a random part of a time.
pub fn random_part(time: Duration) -> Duration {
    let random = getrandom::u32().map_or(0.5, |random| f64::from(random) / f64::from(u32::MAX));
    time.mul_f64(random)
}
