//! Detects a participant that has stopped working.

use std::collections::HashSet;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use super::sockets::{Queues, Sockets, busy, gone};
use super::state::ParticipantState;

/// Consecutive checks without progress after which the participant is dead.
const MAX_STALLED: u32 = 10;
/// Checks that follow each other faster than this count as one.
const SPACING: Duration = Duration::from_millis(900);

/// Checks, about once a second, that a participant works.
#[derive(Debug, Default)]
pub(super) struct Watchdog {
    sockets: Sockets,
    threads: HashSet<u32>,
    checked: Option<Instant>,
    queues: Queues,
    handled: u64,
    /// CPU time of the thread that reads the sockets.
    busy: u64,
    /// Consecutive checks at which datagrams waited, nothing was handled, and the reading thread
    /// used no CPU time: datagrams of no interest may keep a queue filled while no writer sends to
    /// our readers.
    waiting: u32,
    delivery: Option<(u64, usize)>,
    /// Consecutive checks at which the same delivery was in progress.
    delivering: u32,
}

impl Watchdog {
    pub(super) fn new(sockets: Sockets, threads: HashSet<u32>) -> Self {
        Self { sockets, threads, ..Self::default() }
    }

    /// Returns the state of the sockets' queues, and why the participant is dead, if it is.
    /// `topic` returns the topic of a subscription.
    pub(super) fn check<'t>(
        &mut self,
        state: &ParticipantState,
        topic: impl Fn(usize) -> Option<&'t str>,
    ) -> (Queues, Option<String>) {
        let queues = self.sockets.queues();
        if self.checked.is_none_or(|checked| checked.elapsed() >= SPACING) {
            self.checked = Some(Instant::now());
            self.count(
                queues,
                (state.handled.load(Relaxed), busy(&self.threads)),
                state.delivering(),
            );
        }
        self.queues = queues;
        let dead = state.dead().or_else(|| self.cause_of_death(topic));
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

    fn cause_of_death<'t>(&self, topic: impl Fn(usize) -> Option<&'t str>) -> Option<String> {
        if let Some(thread) = gone(&self.threads) {
            return Some(format!("thread {thread} of RustDDS is gone"));
        }
        if self.delivering >= MAX_STALLED {
            let topic = self.delivery.and_then(|(_, index)| topic(index)).unwrap_or("?");
            return Some(format!(
                "the sink of topic `{topic}` has held a sample for {MAX_STALLED} s"
            ));
        }
        let bytes = self.queues.waiting;
        (self.waiting >= MAX_STALLED).then(|| {
            format!("{bytes} bytes wait in sockets, and nothing was received for {MAX_STALLED} s")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watchdog() -> Watchdog {
        Watchdog::new(Sockets::default(), HashSet::new())
    }

    fn check(
        watchdog: &mut Watchdog,
        waiting: u64,
        handled: u64,
        delivery: Option<(u64, usize)>,
    ) -> Option<String> {
        watchdog.queues = Queues { waiting, ..Queues::default() };
        watchdog.count(watchdog.queues, (handled, 0), delivery);
        watchdog.cause_of_death(|_| Some("/imu"))
    }

    #[test]
    fn a_participant_with_waiting_datagrams_is_dead_after_ten_stalled_checks() {
        let mut watchdog = watchdog();
        let causes: Vec<_> = (0..12).map(|_| check(&mut watchdog, 700, 0, None)).collect();
        assert_eq!(causes.iter().position(Option::is_some), Some(9));
        assert!(causes[11].as_ref().unwrap().contains("700 bytes wait"));
    }

    #[test]
    fn one_check_with_progress_or_an_empty_queue_resets_the_count() {
        let mut watchdog = watchdog();
        for round in 0..100 {
            let handled = round / 9;
            assert_eq!(check(&mut watchdog, 700, handled, None), None, "round {round}");
        }
        for round in 0..100_u64 {
            let found = check(&mut watchdog, u64::from(round % 9 != 0), 0, None);
            assert_eq!(found, None, "round {round}");
        }
    }

    #[test]
    fn a_thread_that_reads_datagrams_of_no_interest_is_alive() {
        let mut watchdog = watchdog();
        for busy in 0..100 {
            watchdog.queues = Queues { waiting: 700, ..Queues::default() };
            watchdog.count(watchdog.queues, (0, busy / 9), None);
            assert_eq!(watchdog.cause_of_death(|_| None), None, "check {busy}");
        }
    }

    #[test]
    fn a_sink_that_holds_a_sample_is_named_and_one_that_takes_many_is_not() {
        let mut watchdog = watchdog();
        (0..100).for_each(|n| assert_eq!(check(&mut watchdog, 0, n, Some((2 * n + 1, 0))), None));
        let causes: Vec<_> =
            (0..12).map(|_| check(&mut watchdog, 0, 100, Some((999, 0)))).collect();
        assert_eq!(causes[9], None);
        assert!(causes[11].as_ref().unwrap().contains("`/imu`"));
        assert_eq!(check(&mut watchdog, 0, 101, None), None, "the sink returned");
    }

    #[test]
    fn a_participant_without_a_thread_is_dead_at_once() {
        let watchdog = Watchdog::new(Sockets::default(), HashSet::from([u32::MAX]));
        assert!(watchdog.cause_of_death(|_| None).unwrap().contains("is gone"));
    }
}
