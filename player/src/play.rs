//! Runs the player: opens the source, offers topics, waits for readers, plays, prints the summary.

use std::env;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use rustix::time::ClockId;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::args::Args;
use crate::config;
use crate::cyclone::Participant;
use crate::lane::{self, Outlet};
use crate::names;
use crate::offer::is_large;
use crate::pace::{Pace, Rate};
use crate::queue::Queue;
use crate::source::{self, MessageSource, PlayedTopic};
use crate::stamp::{StampMode, now};
use crate::stderr::{line, warn};
use crate::summary::{self, TopicSummary};

/// Number of lanes for topics with large messages; all others share one.
const LARGE_LANES: usize = 8;

/// Time without readers after which a notice is printed.
const NO_READERS: Duration = Duration::from_secs(3);

/// Maximum wait at the end for readers to acknowledge all messages.
const FLUSH: Duration = Duration::from_secs(5);

pub(crate) fn run(args: &Args) -> Result<Exit, Failure> {
    let domain = args.domain(env::var("ROS_DOMAIN_ID").ok().as_deref())?;
    let stop = stop_on_signals()?;
    let mut source = source::open(args)?;
    let topics = source.topics().to_vec();
    let config = configuration(args);
    let participant = Participant::join(domain, config.as_deref())?;
    let outlets = topics
        .iter()
        .map(|topic| offer(&participant, topic, args.stamp))
        .collect::<Result<Vec<_>, _>>()?;
    line(&format!("playing {} topics in domain {domain}", topics.len()));
    wait_for_readers(&outlets, args.wait, &stop);

    let lanes = lanes(&topics, args.rate);
    let queue =
        Queue::new(lanes.iter().max().map_or(1, |last| last + 1), source.read_ahead(), &stop);
    let (ended, counts, readers, seconds) = thread::scope(|scope| {
        let reader = scope.spawn(|| {
            let ended = read_ahead(source.as_mut(), &lanes, &queue);
            queue.close();
            ended
        });
        queue.wait_until_filled();
        let begin = Instant::now();
        let pace = Pace { rate: args.rate, begin_ns: now(ClockId::Monotonic) };
        let (queue, outlets, stop) = (&queue, outlets.as_slice(), &*stop);
        let work =
            |index| scope.spawn(move || lane::run(queue, index, outlets, &pace, args.stamp, stop));
        let senders: Vec<_> = (0..queue.lanes()).map(work).collect();
        let mut readers = vec![0; outlets.len()];
        track_readers(outlets, &mut readers, || senders.iter().all(|sender| sender.is_finished()));
        let counts =
            senders.into_iter().map(|sender| sender.join().expect("a lane does not panic"));
        let counts: Vec<_> = counts.collect();
        let seconds = begin.elapsed().as_secs_f64();
        (reader.join().expect("reading ahead does not panic"), counts, readers, seconds)
    });
    flush(&outlets);
    let summaries: Vec<_> = (topics.iter().enumerate())
        .map(|(index, topic)| {
            let own_lane = &counts[lanes[index]];
            let undecodable = source.undecodable(index);
            TopicSummary {
                topic,
                counts: own_lane[index].clone(),
                undecodable,
                readers: readers[index],
            }
        })
        .collect();
    print_summary(&summaries, seconds, args.json)?;
    ended.map(|()| Exit::Ok)
}

/// Returns a flag that ctrl-C and SIGTERM set; a second signal ends the process at once.
fn stop_on_signals() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(
            signal,
            i32::from(Exit::Internal.code()),
            stop.clone(),
        )
        .and_then(|_| signal_hook::flag::register(signal, stop.clone()))
        .map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot install signal handlers", &error)
        })?;
    }
    Ok(stop)
}

/// The player's configuration of Cyclone DDS, or `None` if the user set one.
fn configuration(args: &Args) -> Option<String> {
    if env::var_os("CYCLONEDDS_URI").is_none_or(|uri| uri.is_empty()) {
        return Some(config::xml(args.interface));
    }
    line(
        "CYCLONEDDS_URI is set and replaces the player's configuration of Cyclone DDS; \
         see docs/play.md for the settings that images of 25 MB need",
    );
    if args.interface.is_some() {
        warn("--interface has no effect while CYCLONEDDS_URI is set");
    }
    None
}

fn offer<'p>(
    participant: &'p Participant,
    topic: &PlayedTopic,
    stamp: StampMode,
) -> Result<Outlet<'p>, Failure> {
    let PlayedTopic { topic: name, type_name, offer, is_stamped } = topic;
    let unusable = || {
        Failure::new(
            Exit::Usage,
            format!("topic `{name}` of type `{type_name}` is not valid in ROS 2"),
        )
    };
    let dds_topic = names::dds_topic(name).ok_or_else(unusable)?;
    let dds_type = names::dds_type(type_name).ok_or_else(unusable)?;
    let writer = participant.writer(&dds_topic, &dds_type, *offer)?;
    if !is_stamped && stamp != StampMode::Recorded {
        line(&format!("`{name}` is sent as recorded: its type has no known stamp at its begin"));
    }
    Ok(Outlet { topic: name.clone(), writer, is_stamped: *is_stamped })
}

/// The lane of each topic. At maximum rate there is only one lane, because nothing else keeps the
/// order of the drive.
fn lanes(topics: &[PlayedTopic], rate: Rate) -> Vec<usize> {
    let mut large = 0;
    let lane = |topic: &PlayedTopic| {
        if rate == Rate::Max || !is_large(&topic.type_name) {
            return 0;
        }
        large += 1;
        1 + (large - 1) % LARGE_LANES
    };
    topics.iter().map(lane).collect()
}

fn read_ahead(
    source: &mut dyn MessageSource,
    lanes: &[usize],
    queue: &Queue<'_>,
) -> Result<(), Failure> {
    while let Some(message) = source.next()? {
        if !queue.push(lanes[message.topic], message) {
            break;
        }
    }
    Ok(())
}

fn wait_for_readers(outlets: &[Outlet<'_>], wanted: usize, stop: &AtomicBool) {
    let mut printed = Instant::now();
    while let Some(outlet) = outlets.iter().find(|outlet| outlet.writer.readers() < wanted) {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        if printed.elapsed() >= NO_READERS {
            let readers = outlet.writer.readers();
            line(&format!("waiting for readers: `{}` has {readers} of {wanted}", outlet.topic));
            printed = Instant::now();
        }
        thread::sleep(Duration::from_millis(10));
    }
}

/// Records the maximum readers of each topic until playing is over. Warns once if there are none.
fn track_readers(outlets: &[Outlet<'_>], readers: &mut [usize], is_over: impl Fn() -> bool) {
    let begin = Instant::now();
    let mut is_checked = false;
    loop {
        let is_last = is_over();
        for (most, outlet) in readers.iter_mut().zip(outlets) {
            *most = outlet.writer.readers().max(*most);
        }
        if !is_checked && (begin.elapsed() >= NO_READERS || is_last) {
            is_checked = true;
            if readers.iter().all(|readers| *readers == 0) {
                warn(
                    "no readers found; check that they are in the same domain and that their QoS \
                     requests no more than is offered",
                );
            }
        }
        if is_last {
            return;
        }
        thread::sleep(Duration::from_millis(20));
    }
}

/// Waits until readers have acknowledged all messages: the end of the process would discard the
/// rest.
fn flush(outlets: &[Outlet<'_>]) {
    let until = Instant::now() + FLUSH;
    for outlet in outlets {
        if !outlet.writer.flush(until.saturating_duration_since(Instant::now())) {
            warn(&format!("readers of `{}` did not acknowledge everything", outlet.topic));
        }
    }
}

fn print_summary(
    summaries: &[TopicSummary<'_>],
    seconds: f64,
    as_json: bool,
) -> Result<(), Failure> {
    let text = if as_json {
        format!("{}\n", summary::json(summaries, seconds))
    } else {
        summary::text(summaries, seconds)
    };
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::caused_by(Exit::Internal, "cannot write to standard output", &error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offer::Offer;

    #[test]
    fn large_topics_have_separate_lanes_except_at_maximum_rate() {
        let topic = |type_name: &str| PlayedTopic {
            topic: "/a".to_owned(),
            type_name: type_name.to_owned(),
            offer: Offer::default(),
            is_stamped: true,
        };
        let (image, imu) = (topic("sensor_msgs/msg/Image"), topic("sensor_msgs/msg/Imu"));
        let topics = [imu.clone(), image.clone(), imu, image.clone()];
        assert_eq!(lanes(&topics, Rate::Times(1.0)), [0, 1, 0, 2]);
        assert_eq!(lanes(&topics, Rate::Max), [0, 0, 0, 0]);
        let many = lanes(&vec![image; 1000], Rate::Times(1.0));
        assert_eq!(many.iter().max(), Some(&LARGE_LANES));
    }
}
