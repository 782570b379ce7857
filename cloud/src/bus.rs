//! Hints between replicas: what may have changed. PostgreSQL is the only truth: who receives a hint
//! reads it there. A hint that is lost, late or wrong changes nothing but the time after which a
//! replica looks.
//!
//! Hints travel by NATS, to which `scaled` connects. A server that is down, slow or hostile keeps
//! no request waiting: what does not fit into the queue is dropped and counted.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use tokio::sync::{Notify, mpsc};

/// Maximum number of names in a hint, and of those that wait to be looked at.
const NAMES_MAX: usize = 256;
const WAITING_MAX: usize = 20_000;
/// Maximum length of a hint, and of a name in it.
const HINT_MAX: usize = 64 << 10;
const NAME_MAX: usize = 200;

/// A thing that may have changed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Hint {
    /// The connections or the desired states of these vehicles.
    Vehicles(Vec<String>),
    Records(String),
    /// The leases of streams that people read.
    #[serde(rename = "tails")]
    LiveStreams,
}

#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct HintedChanges {
    pub(crate) changed: BTreeSet<String>,
    pub(crate) with_records: BTreeSet<String>,
    pub(crate) has_live_streams: bool,
}

/// The hints that were received, until they are looked at.
#[derive(Debug, Default)]
pub(crate) struct ReceivedHints {
    waiting: Mutex<HintedChanges>,
    notify: Notify,
    /// Number of messages that were no hint, or did not fit.
    ignored: AtomicU64,
}

/// The sending side; without a bus, it drops everything.
#[derive(Debug, Default)]
pub(crate) struct Bus {
    queue: Option<mpsc::Sender<Hint>>,
    dropped: AtomicU64,
}

impl Bus {
    pub(crate) fn of_queue(queue: mpsc::Sender<Hint>) -> Self {
        Self { queue: Some(queue), dropped: AtomicU64::new(0) }
    }

    pub(crate) fn changed(&self, names: &[String]) {
        for names in names.chunks(NAMES_MAX) {
            self.send(|| Hint::Vehicles(names.to_vec()));
        }
    }

    pub(crate) fn send(&self, hint: impl FnOnce() -> Hint) {
        let Some(queue) = &self.queue else { return };
        if queue.try_send(hint()).is_err() {
            let dropped = self.dropped.fetch_add(1, Ordering::Relaxed) + 1;
            if dropped.is_power_of_two() {
                tracing::warn!(dropped, "dropped messages to the bus: it is slow or down");
            }
        }
    }
}

impl ReceivedHints {
    /// Adds a message, if it is a hint.
    pub(crate) fn add(&self, payload: &[u8]) {
        let hint = match payload.len() <= HINT_MAX {
            true => serde_json::from_slice::<Hint>(payload).ok(),
            false => None,
        };
        let is_added = hint.is_some_and(|hint| {
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let HintedChanges { changed, with_records, has_live_streams } = &mut *waiting;
            let (set, names) = match hint {
                Hint::Vehicles(names) => (changed, names),
                Hint::Records(name) => (with_records, vec![name]),
                Hint::LiveStreams => {
                    *has_live_streams = true;
                    return true;
                }
            };
            let is_fit = names.iter().all(|name| name.len() <= NAME_MAX)
                && set.len() + names.len() <= WAITING_MAX;
            if is_fit {
                set.extend(names);
            }
            is_fit
        });
        if is_added {
            self.notify.notify_one();
            return;
        }
        let ignored = self.ignored.fetch_add(1, Ordering::Relaxed) + 1;
        if ignored.is_power_of_two() {
            tracing::warn!(ignored, "ignored messages on the bus of an unknown form");
        }
    }

    /// Waits for hints, and takes all that were received.
    pub(crate) async fn next(&self) -> HintedChanges {
        loop {
            self.notify.notified().await;
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let taken = std::mem::take(&mut *waiting);
            if taken != HintedChanges::default() {
                return taken;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_is_no_hint_is_counted_and_ignored() {
        let received = ReceivedHints::default();
        let long = format!("{{\"records\":\"{}\"}}", "x".repeat(NAME_MAX + 1));
        let huge = format!("{{\"records\":\"{}\"}}", "x".repeat(HINT_MAX));
        let wrong = ["", "x", "{}", "{\"users\":[]}", "{\"vehicles\":[1]}", &long, &huge];
        for payload in wrong {
            received.add(payload.as_bytes());
        }
        received.add(&[0xff; 10]);
        assert_eq!(received.ignored.load(Ordering::Relaxed), wrong.len() as u64 + 1);
        received.add(br#"{"vehicles":["car-7","car-8"]}"#);
        received.add(br#"{"records":"car-7"}"#);
        received.add(br#""tails""#);
        let taken = received.next().await;
        assert_eq!(taken.changed.into_iter().collect::<Vec<_>>(), ["car-7", "car-8"]);
        assert_eq!(taken.with_records.into_iter().collect::<Vec<_>>(), ["car-7"]);
        assert!(taken.has_live_streams);
    }

    #[tokio::test]
    async fn hints_that_nothing_sends_are_dropped() {
        let (queue, _waiting) = mpsc::channel(1);
        let bus = Bus::of_queue(queue);
        let names: Vec<_> = (0..3 * NAMES_MAX).map(|it| it.to_string()).collect();
        bus.changed(&names);
        assert_eq!(bus.dropped.load(Ordering::Relaxed), 2, "of three messages, one has room");
    }
}
