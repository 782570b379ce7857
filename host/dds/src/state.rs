//! State that the receive thread shares with the callers of [`Dds`](super::Dds).

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rustdds::GUID;
use tracing::error;

use super::peers::Peers;
use super::type_check::TopicLayout;
use super::type_query::QueryOutcome;
use super::{Distro, names};
use gleaner_messages::transport::{Guid, ReceptionStatus};

pub(super) const UNKNOWN: u64 = u64::MAX;

#[derive(Debug, Default)]
pub(super) struct ParticipantState {
    dead: Mutex<Option<String>>,
    peers: Mutex<Peers>,
    graph: Mutex<(String, Option<Distro>)>,
    unfiltered: Mutex<Option<String>>,
    /// The outcome of the type query with this ticket.
    answer: Mutex<Option<(u64, QueryOutcome)>>,
    /// Number of samples and events that were handled.
    pub(super) handled: AtomicU64,
    /// Odd while a sink may have a sample.
    delivering: AtomicU64,
    /// The subscription whose sink has the sample.
    to: AtomicUsize,
}

#[derive(Debug, Default)]
pub(super) struct SubscriptionStatus {
    /// Set when the subscription has ended: its sink gets no further samples.
    pub(super) ended: AtomicBool,
    pub(super) lost: AtomicU64,
    /// [`UNKNOWN`] if it is unknown.
    pub(super) before_match: AtomicU64,
    pub(super) malformed: AtomicU64,
    pub(super) layout: TopicLayout,
    pub(super) text: Mutex<StatusText>,
}

#[derive(Debug, Default)]
pub(super) struct StatusText {
    pub(super) reader: Option<GUID>,
    pub(super) qos: Option<String>,
    pub(super) qos_warnings: Vec<String>,
    /// Writers that do not count as connected, though RustDDS may take them as matched.
    pub(super) left_out: HashSet<Guid>,
}

/// Locks `mutex` even after a panic: the state stays valid.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ParticipantState {
    /// Records why nothing, or nothing of a topic, is handled any more. The first reason stays.
    pub(super) fn die(&self, why: String) {
        error!(why, "DDS receive failed; no further samples");
        lock(&self.dead).get_or_insert(why);
    }

    pub(super) fn dead(&self) -> Option<String> {
        lock(&self.dead).clone()
    }

    pub(super) fn peers(&self) -> MutexGuard<'_, Peers> {
        lock(&self.peers)
    }

    pub(super) fn set_graph(&self, listing: String, distro: Option<Distro>) {
        *lock(&self.graph) = (listing, distro);
    }

    pub(super) fn graph(&self) -> (String, Option<Distro>) {
        lock(&self.graph).clone()
    }

    /// Records why hostile fragments are not filtered.
    pub(super) fn set_unfiltered(&self, why: String) {
        *lock(&self.unfiltered) = Some(why);
    }

    pub(super) fn unfiltered(&self) -> Option<String> {
        lock(&self.unfiltered).clone()
    }

    pub(super) fn answer(&self, ticket: u64, outcome: QueryOutcome) {
        *lock(&self.answer) = Some((ticket, outcome));
    }

    /// Takes the outcome of a type query, if it is there.
    pub(super) fn answered(&self, ticket: u64) -> Option<QueryOutcome> {
        lock(&self.answer).take_if(|(of, _)| *of == ticket).map(|(_, outcome)| outcome)
    }

    /// Marks that a sink gets a sample, or returns from it.
    pub(super) fn deliver(&self, to: usize) {
        self.to.store(to, Ordering::Relaxed);
        self.delivering.fetch_add(1, Ordering::Release);
    }

    /// The delivery in progress: its number, and the index of the subscription.
    pub(super) fn delivering(&self) -> Option<(u64, usize)> {
        let count = self.delivering.load(Ordering::Acquire);
        (count % 2 == 1).then(|| (count, self.to.load(Ordering::Relaxed)))
    }
}

impl SubscriptionStatus {
    pub(super) fn status(&self, state: &ParticipantState) -> ReceptionStatus {
        let text = lock(&self.text);
        ReceptionStatus {
            writers: Some(
                text.reader.map_or(0, |reader| state.peers().connected_but(reader, &text.left_out)),
            ),
            lost: Some(self.lost.load(Ordering::Relaxed)),
            before_match: Some(self.before_match.load(Ordering::Relaxed))
                .filter(|count| *count != UNKNOWN),
            malformed: self.malformed.load(Ordering::Relaxed),
            qos: text.qos.clone(),
            qos_warnings: text.qos_warnings.clone(),
        }
    }
}

/// Limits logging to the first occurrence of each message, and to a number of messages per cause,
/// so that one cause that others control cannot use up the log.
#[derive(Debug, Default)]
pub(super) struct OnceLog {
    logged: HashMap<&'static str, HashSet<String>>,
}

impl OnceLog {
    const MOST: usize = 64;

    /// Returns whether `what` is new for `cause`, and there is room to remember it.
    pub(super) fn first(&mut self, cause: &'static str, what: &str) -> bool {
        let logged = self.logged.entry(cause).or_default();
        logged.len() < Self::MOST && logged.insert(what.to_owned())
    }
}

pub(super) fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    names::visible(text.unwrap_or("no text"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_message_is_logged_once_and_a_flood_of_one_cause_silences_no_other() {
        let mut once = OnceLog::default();
        assert!(once.first("lost", ""));
        assert!(!once.first("lost", ""));
        let logged =
            (0..10_000).filter(|n| once.first("another type", &format!("writer {n}"))).count();
        assert_eq!(logged, OnceLog::MOST);
        assert!(once.first("malformed", "") && once.first("offers less", "writer 1"));
    }
}
