//! The course of events: open, offer, wait for readers, play, say what became of it.

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
use crate::say::{line, warn};
use crate::source::{self, Source, Topic};
use crate::stamp::{Stamp, now};
use crate::summary::{self, Line};

/// Lanes for topics with large messages; the others share one.
const LARGE_LANES: usize = 8;

/// After which time without any reader people are told.
const LONELY: Duration = Duration::from_secs(3);

/// How long the end waits for readers to acknowledge what was sent.
const FLUSH: Duration = Duration::from_secs(5);

/// Plays what the arguments ask for.
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
        watch(outlets, &mut readers, || senders.iter().all(|sender| sender.is_finished()));
        let counts =
            senders.into_iter().map(|sender| sender.join().expect("a lane does not panic"));
        let counts: Vec<_> = counts.collect();
        let seconds = begin.elapsed().as_secs_f64();
        (reader.join().expect("reading ahead does not panic"), counts, readers, seconds)
    });
    flush(&outlets);
    let lines: Vec<_> = (topics.iter().enumerate())
        .map(|(index, topic)| {
            let own_lane = &counts[lanes[index]];
            let undecodable = source.undecodable(index);
            Line { topic, counts: own_lane[index].clone(), undecodable, readers: readers[index] }
        })
        .collect();
    show(&lines, seconds, args.json)?;
    ended.map(|()| Exit::Ok)
}

/// A flag that ctrl-C and SIGTERM set; a second one ends the process at once.
fn stop_on_signals() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(
            signal,
            i32::from(Exit::Internal.code()),
            stop.clone(),
        )
        .and_then(|_| signal_hook::flag::register(signal, stop.clone()))
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot listen to signals", &error))?;
    }
    Ok(stop)
}

/// Our configuration of Cyclone DDS, or `None` if the user has one.
fn configuration(args: &Args) -> Option<String> {
    if env::var_os("CYCLONEDDS_URI").is_none_or(|uri| uri.is_empty()) {
        return Some(config::xml(args.interface));
    }
    line(
        "CYCLONEDDS_URI is set: Cyclone DDS is configured by it alone, see docs/play.md for what images of 25 MB need",
    );
    if args.interface.is_some() {
        warn("--interface has no effect while CYCLONEDDS_URI is set");
    }
    None
}

fn offer<'p>(
    participant: &'p Participant,
    topic: &Topic,
    stamp: Stamp,
) -> Result<Outlet<'p>, Failure> {
    let Topic { topic: name, type_name, offer, is_stamped } = topic;
    let unusable = || {
        Failure::new(Exit::Usage, format!("ROS 2 takes no topic `{name}` of type `{type_name}`"))
    };
    let dds_topic = names::dds_topic(name).ok_or_else(unusable)?;
    let dds_type = names::dds_type(type_name).ok_or_else(unusable)?;
    let writer = participant.writer(&dds_topic, &dds_type, *offer)?;
    if !is_stamped && stamp != Stamp::Recorded {
        line(&format!(
            "`{name}` is sent as recorded: its type does not begin with a stamp, as far as the drive tells"
        ));
    }
    Ok(Outlet { topic: name.clone(), writer, is_stamped: *is_stamped })
}

/// The lane of each topic. As fast as possible there is one, since nothing else keeps the order of
/// the drive.
fn lanes(topics: &[Topic], rate: Rate) -> Vec<usize> {
    let mut large = 0;
    let lane = |topic: &Topic| {
        if rate == Rate::Max || !is_large(&topic.type_name) {
            return 0;
        }
        large += 1;
        1 + (large - 1) % LARGE_LANES
    };
    topics.iter().map(lane).collect()
}

fn read_ahead(source: &mut dyn Source, lanes: &[usize], queue: &Queue<'_>) -> Result<(), Failure> {
    while let Some(message) = source.next()? {
        if !queue.push(lanes[message.topic], message) {
            break;
        }
    }
    Ok(())
}

fn wait_for_readers(outlets: &[Outlet<'_>], wanted: usize, stop: &AtomicBool) {
    let mut said = Instant::now();
    while let Some(outlet) = outlets.iter().find(|outlet| outlet.writer.readers() < wanted) {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        if said.elapsed() >= LONELY {
            let readers = outlet.writer.readers();
            line(&format!("waiting: `{}` has {readers} readers of {wanted}", outlet.topic));
            said = Instant::now();
        }
        thread::sleep(Duration::from_millis(10));
    }
}

/// Notes the readers of each topic until playing is over, and says once if there are none at all.
fn watch(outlets: &[Outlet<'_>], readers: &mut [usize], is_over: impl Fn() -> bool) {
    let begin = Instant::now();
    let mut is_told = false;
    loop {
        let is_last = is_over();
        for (most, outlet) in readers.iter_mut().zip(outlets) {
            *most = outlet.writer.readers().max(*most);
        }
        if !is_told && (begin.elapsed() >= LONELY || is_last) {
            is_told = true;
            if readers.iter().all(|readers| *readers == 0) {
                warn(
                    "no reader was found; is it in the same domain, and does it ask for no more than is offered?",
                );
            }
        }
        if is_last {
            return;
        }
        thread::sleep(Duration::from_millis(20));
    }
}

/// Waits until readers have what was sent, so that the end of the process does not take it away
/// from them.
fn flush(outlets: &[Outlet<'_>]) {
    let until = Instant::now() + FLUSH;
    for outlet in outlets {
        if !outlet.writer.flush(until.saturating_duration_since(Instant::now())) {
            warn(&format!("readers of `{}` did not acknowledge everything", outlet.topic));
        }
    }
}

fn show(lines: &[Line<'_>], seconds: f64, as_json: bool) -> Result<(), Failure> {
    let text = if as_json {
        format!("{}\n", summary::json(lines, seconds))
    } else {
        summary::text(lines, seconds)
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
    fn large_topics_have_lanes_of_their_own_unless_nothing_else_keeps_the_order() {
        let topic = |type_name: &str| Topic {
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
