//! A lane: one thread that sends the messages of some topics when they are due.

use std::sync::atomic::AtomicBool;

use rustix::time::ClockId;

use crate::counts::{Counts, LATE_NS};
use crate::cyclone::Writer;
use crate::pace::Pace;
use crate::queue::Queue;
use crate::say::warn;
use crate::stamp::{self, Stamp};

/// A topic that is played.
pub(crate) struct Outlet<'p> {
    /// As ROS 2 calls it.
    pub(crate) topic: String,
    pub(crate) writer: Writer<'p>,
    /// Whether its messages begin with a stamp that we write.
    pub(crate) is_stamped: bool,
}

/// From which delay on people are told at once that the player falls behind.
const BEHIND_NS: i64 = 100_000_000;

/// Sends what comes through `lane` of `queue`, until the queue is closed and empty or the player
/// stops. Returns the counts of all topics; those of other lanes are zero.
pub(crate) fn run(
    queue: &Queue<'_>,
    lane: usize,
    outlets: &[Outlet<'_>],
    pace: &Pace,
    stamp: Stamp,
    stop: &AtomicBool,
) -> Vec<Counts> {
    let mut counts = vec![Counts::default(); outlets.len()];
    while let Some(mut message) = queue.pop(lane) {
        let Some(late_ns) = pace.wait(message.at_ns, stop) else { break };
        let (outlet, counts) = (&outlets[message.topic], &mut counts[message.topic]);
        if late_ns > LATE_NS {
            counts.late += 1;
        }
        if late_ns > BEHIND_NS && counts.latest_ns <= BEHIND_NS {
            let late_s = late_ns as f64 / 1e9;
            warn(&format!(
                "the player is behind: a message of `{}` was {late_s:.1} s late; the summary counts them",
                outlet.topic
            ));
        }
        counts.latest_ns = counts.latest_ns.max(late_ns);
        if outlet.is_stamped
            && !stamp::write(&mut message.bytes, message.endian, stamp, message.rounds_ns)
        {
            counts.unstamped += 1;
        }
        let len = message.bytes.len();
        let before_ns = stamp::now(ClockId::Monotonic);
        let written = outlet.writer.write(message.bytes);
        counts.writes.add(stamp::now(ClockId::Monotonic).abs_diff(before_ns));
        match written {
            Ok(()) => {
                counts.sent += 1;
                counts.bytes += len as u64;
            }
            Err(error) => {
                if counts.refused == 0 {
                    warn(&format!(
                        "a message of `{}` was not sent: {error}; the summary counts them",
                        outlet.topic
                    ));
                }
                counts.refused += 1;
            }
        }
        queue.sent(len);
    }
    counts
}
