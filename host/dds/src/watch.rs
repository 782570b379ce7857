//! Whether a participant still does its work.

use std::collections::HashSet;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use super::sockets::{Queues, Sockets, busy, gone};
use super::state::State;

/// Looks in a row at which something stood still, until it is said to be dead.
const LOOKS: u32 = 10;
/// Looks that follow each other faster than this are one.
const SPACING: Duration = Duration::from_millis(900);

/// Looks, about once a second, whether a participant still does its work.
#[derive(Debug)]
pub(super) struct Watch {
    sockets: Sockets,
    threads: HashSet<u32>,
    looked: Option<Instant>,
    queues: Queues,
    handled: u64,
    /// CPU time of the thread that reads the sockets.
    busy: u64,
    /// Looks in a row at which datagrams waited, nothing was handled, and nobody worked on it:
    /// datagrams that are none of our business may keep a queue filled while nobody writes what we
    /// listen to.
    waiting: u32,
    delivery: Option<(u64, usize)>,
    /// Looks in a row at which the same delivery was going on.
    delivering: u32,
}

impl Watch {
    pub(super) fn new(sockets: Sockets, threads: HashSet<u32>) -> Self {
        Self {
            sockets,
            threads,
            looked: None,
            queues: Queues::default(),
            handled: 0,
            busy: 0,
            waiting: 0,
            delivery: None,
            delivering: 0,
        }
    }

    /// What the sockets' queues are like, and why the participant is dead, if it is. `topics` names
    /// subscriptions.
    pub(super) fn look(&mut self, state: &State, topics: &[String]) -> (Queues, Option<String>) {
        let queues = self.sockets.queues();
        if self.looked.is_none_or(|looked| looked.elapsed() >= SPACING) {
            self.looked = Some(Instant::now());
            self.count(
                queues,
                (state.handled.load(Relaxed), busy(&self.threads)),
                state.delivering(),
            );
        }
        self.queues = queues;
        let dead = state.dead().or_else(|| self.verdict(topics));
        (queues, dead)
    }

    fn count(
        &mut self,
        queues: Queues,
        (handled, busy): (u64, u64),
        delivery: Option<(u64, usize)>,
    ) {
        let still = queues.waiting > 0 && handled == self.handled && busy == self.busy;
        self.waiting = if still { self.waiting + 1 } else { 0 };
        (self.handled, self.busy) = (handled, busy);
        let same = delivery.is_some() && delivery == self.delivery;
        self.delivering = if same { self.delivering + 1 } else { 0 };
        self.delivery = delivery;
    }

    fn verdict(&self, topics: &[String]) -> Option<String> {
        if let Some(thread) = gone(&self.threads) {
            return Some(format!("thread {thread} of RustDDS is gone"));
        }
        if self.delivering >= LOOKS {
            let topic =
                self.delivery.and_then(|(_, index)| topics.get(index)).map_or("?", String::as_str);
            return Some(format!(
                "the sink of topic `{topic}` has not given back a sample for {LOOKS} s"
            ));
        }
        let bytes = self.queues.waiting;
        (self.waiting >= LOOKS).then(|| {
            format!("{bytes} bytes wait in sockets, and nothing was handled for {LOOKS} s")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watch() -> Watch {
        Watch::new(Sockets::default(), HashSet::new())
    }

    fn look(
        watch: &mut Watch,
        waiting: u64,
        handled: u64,
        delivery: Option<(u64, usize)>,
    ) -> Option<String> {
        watch.queues = Queues { waiting, ..Queues::default() };
        watch.count(watch.queues, (handled, 0), delivery);
        watch.verdict(&["/imu".to_owned()])
    }

    #[test]
    fn datagrams_that_wait_while_nothing_is_handled_are_death_after_ten_looks() {
        let mut watch = watch();
        let verdicts: Vec<_> = (0..12).map(|_| look(&mut watch, 700, 0, None)).collect();
        assert_eq!(verdicts.iter().position(Option::is_some), Some(9));
        assert!(verdicts[11].as_ref().unwrap().contains("700 bytes wait"));
    }

    #[test]
    fn one_look_at_which_something_was_handled_or_nothing_waits_is_life() {
        let mut watch = watch();
        for round in 0..100 {
            let handled = round / 9;
            assert_eq!(look(&mut watch, 700, handled, None), None, "round {round}");
        }
        for round in 0..100_u64 {
            assert_eq!(look(&mut watch, u64::from(round % 9 != 0), 0, None), None, "round {round}");
        }
    }

    #[test]
    fn a_thread_that_works_through_datagrams_of_others_is_alive() {
        let mut watch = watch();
        for busy in 0..100 {
            watch.queues = Queues { waiting: 700, ..Queues::default() };
            watch.count(watch.queues, (0, busy / 9), None);
            assert_eq!(watch.verdict(&[]), None, "look {busy}");
        }
    }

    #[test]
    fn a_sink_that_keeps_a_sample_is_named_and_one_that_takes_many_is_not() {
        let mut watch = watch();
        (0..100).for_each(|n| assert_eq!(look(&mut watch, 0, n, Some((2 * n + 1, 0))), None));
        let verdicts: Vec<_> = (0..12).map(|_| look(&mut watch, 0, 100, Some((999, 0)))).collect();
        assert_eq!(verdicts[9], None);
        assert!(verdicts[11].as_ref().unwrap().contains("`/imu`"));
        assert_eq!(look(&mut watch, 0, 101, None), None, "it came back");
    }

    #[test]
    fn a_thread_that_is_gone_is_death_at_once() {
        let watch = Watch::new(Sockets::default(), HashSet::from([u32::MAX]));
        assert!(watch.verdict(&[]).unwrap().contains("is gone"));
    }
}
