//! What the receive thread tells those who ask.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rustdds::GUID;
use tracing::error;

use super::ask::Outcome;
use super::peers::Peers;
use super::{Distro, names};
use gleaner_transport::Status;

/// Of the participant.
#[derive(Debug, Default)]
pub(super) struct State {
    dead: Mutex<Option<String>>,
    peers: Mutex<Peers>,
    graph: Mutex<(String, Option<Distro>)>,
    unfiltered: Mutex<Option<String>>,
    /// What became of the question with this ticket.
    answer: Mutex<Option<(u64, Outcome)>>,
    /// Samples and events that were handled.
    pub(super) handled: AtomicU64,
    /// Odd while a sink may have a sample.
    delivering: AtomicU64,
    /// The subscription whose sink has it.
    to: AtomicUsize,
}

/// Of one subscription.
#[derive(Debug, Default)]
pub(super) struct Told {
    pub(super) lost: AtomicU64,
    pub(super) malformed: AtomicU64,
    pub(super) words: Mutex<Words>,
}

#[derive(Debug, Default)]
pub(super) struct Words {
    pub(super) reader: Option<GUID>,
    pub(super) qos: Option<String>,
    pub(super) qos_warnings: Vec<String>,
}

/// A panic elsewhere does not make what is told less true.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl State {
    /// Notes why nothing, or nothing of a topic, is handled any more. The first reason stays.
    pub(super) fn die(&self, why: String) {
        error!(why, "DDS is not received any more");
        lock(&self.dead).get_or_insert(why);
    }

    pub(super) fn dead(&self) -> Option<String> {
        lock(&self.dead).clone()
    }

    pub(super) fn peers(&self) -> MutexGuard<'_, Peers> {
        lock(&self.peers)
    }

    pub(super) fn set_graph(&self, words: String, distro: Option<Distro>) {
        *lock(&self.graph) = (words, distro);
    }

    pub(super) fn graph(&self) -> (String, Option<Distro>) {
        lock(&self.graph).clone()
    }

    /// Notes why hostile fragments are not kept away.
    pub(super) fn set_unfiltered(&self, why: String) {
        *lock(&self.unfiltered) = Some(why);
    }

    pub(super) fn unfiltered(&self) -> Option<String> {
        lock(&self.unfiltered).clone()
    }

    pub(super) fn answer(&self, ticket: u64, outcome: Outcome) {
        *lock(&self.answer) = Some((ticket, outcome));
    }

    /// What became of a question, if it is known. Told once.
    pub(super) fn answered(&self, ticket: u64) -> Option<Outcome> {
        lock(&self.answer).take_if(|(of, _)| *of == ticket).map(|(_, outcome)| outcome)
    }

    /// A sink gets a sample, or gives it back.
    pub(super) fn deliver(&self, to: usize) {
        self.to.store(to, Ordering::Relaxed);
        self.delivering.fetch_add(1, Ordering::Release);
    }

    /// Which delivery is going on, and to which subscription.
    pub(super) fn delivering(&self) -> Option<(u64, usize)> {
        let count = self.delivering.load(Ordering::Acquire);
        (count % 2 == 1).then(|| (count, self.to.load(Ordering::Relaxed)))
    }
}

impl Told {
    pub(super) fn status(&self, state: &State) -> Status {
        let words = lock(&self.words);
        Status {
            writers: Some(words.reader.map_or(0, |reader| state.peers().connected(reader))),
            lost: Some(self.lost.load(Ordering::Relaxed)),
            malformed: self.malformed.load(Ordering::Relaxed),
            qos: words.qos.clone(),
            qos_warnings: words.qos_warnings.clone(),
        }
    }
}

/// Says each thing once. Of one cause only so many things: what others send must not use up what
/// there is to say of other causes.
#[derive(Debug, Default)]
pub(super) struct Once {
    said: HashMap<&'static str, HashSet<String>>,
}

impl Once {
    const MOST: usize = 64;

    /// Whether `what` is new among what `cause` had to say, and there is room to remember it.
    pub(super) fn first(&mut self, cause: &'static str, what: &str) -> bool {
        let said = self.said.entry(cause).or_default();
        said.len() < Self::MOST && said.insert(what.to_owned())
    }
}

/// The text of a panic.
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
    fn each_thing_is_said_once_and_a_flood_of_one_cause_silences_no_other() {
        let mut once = Once::default();
        assert!(once.first("lost", ""));
        assert!(!once.first("lost", ""));
        let said =
            (0..10_000).filter(|n| once.first("another type", &format!("writer {n}"))).count();
        assert_eq!(said, Once::MOST);
        assert!(once.first("malformed", "") && once.first("offers less", "writer 1"));
    }
}
