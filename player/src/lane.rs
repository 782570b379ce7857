//! A lane: a thread that sends the messages of some topics when they are due.

use std::sync::atomic::AtomicBool;

use rustix::time::ClockId;

use crate::counts::{LATE_NS, TopicCounts};
use crate::cyclone::CycloneWriter;
use crate::pace::Pace;
use crate::queue::Queue;
use crate::stamp::{self, StampMode};
use crate::stderr::warn;

pub(crate) struct Outlet<'p> {
    /// Its ROS 2 name.
    pub(crate) topic: String,
    pub(crate) writer: CycloneWriter<'p>,
    /// Set if its messages begin with a stamp that the player writes.
    pub(crate) is_stamped: bool,
}

/// Delay from which a warning is printed at once.
const BEHIND_NS: i64 = 100_000_000;

/// Sends the messages of lane `lane` of `queue` until the queue is closed and empty, or the player
/// stops. Returns the counts of all topics; those of other lanes are zero.
pub(crate) fn run(
    queue: &Queue<'_>,
    lane: usize,
    outlets: &[Outlet<'_>],
    pace: &Pace,
    stamp: StampMode,
    stop: &AtomicBool,
) -> Vec<TopicCounts> {
    let mut counts = vec![TopicCounts::default(); outlets.len()];
    while let Some(mut message) = queue.pop(lane) {
        let Some(late_ns) = pace.wait(message.at_ns, stop) else { break };
        let (outlet, counts) = (&outlets[message.topic], &mut counts[message.topic]);
        if late_ns > LATE_NS {
            counts.late += 1;
        }
        if late_ns > BEHIND_NS && counts.latest_ns <= BEHIND_NS {
            let late_s = late_ns as f64 / 1e9;
            warn(&format!(
                "the player is behind: a message of `{}` was {late_s:.1} s late; \
                 the summary has the count",
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
                        "cannot send a message of `{}`: {error}; the summary has the count",
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
