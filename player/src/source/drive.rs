//! The source that reads drives: its topics, and its messages, round after round.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_base::{Exit, Explain, Failure};
use gleaner_drives::{DriveOptions, Replay, ReplayError};
use gleaner_messages::Endian;
use gleaner_messages::transport::{
    Delivery, DiscoveredTopic, Qos, SampleMeta, Sink, TopicSpec, Transport,
};

use super::images::Decoder;
use super::{MessageSource, PlayedTopic, Remaps};
use crate::args::Args;
use crate::buffer::{Buffer, Pool};
use crate::offer::{Offer, is_large};
use crate::queue::QueuedMessage;
use crate::stderr::warn;
use crate::{cdr, names, stamp};

/// Time between the last message of a round and the first of the next.
const GAP_NS: i64 = 10_000_000;

/// Size from which on messages are put into pooled buffers.
const LARGE: usize = 256 << 10;

#[derive(Debug, thiserror::Error)]
#[error(transparent)]
struct DriveError(ReplayError);

impl Explain for DriveError {
    fn help(&self) -> Option<String> {
        let help = self.0.help();
        match self.0 {
            ReplayError::Damaged { .. } => {
                help.map(|help| format!("it was played up to the damage; {help}"))
            }
            _ => help,
        }
    }

    fn exit(&self) -> Exit {
        self.0.exit()
    }
}

pub(crate) struct Drive {
    paths: Vec<PathBuf>,
    topics: Vec<PlayedTopic>,
    /// Name and type of each topic in the drive, and whether its images are decoded.
    recorded: Vec<(TopicSpec, bool)>,
    replay: Replay,
    inbox: Arc<Inbox>,
    decoder: Decoder,
    undecodable: Vec<u64>,
    /// Log times to play: from the first, up to but not including the second.
    window: (i64, i64),
    /// Duration of a round with `--loop`.
    round_ns: Option<i64>,
    rounds: i64,
    /// Set if the current round had a message.
    is_alive: bool,
}

/// Receives the messages of the replay, one at a time.
struct Inbox {
    pool: Pool,
    taken: Mutex<Option<(Endian, Buffer)>>,
}

impl Sink for Inbox {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let len = cdr.len() + cdr::ENCAPSULATION;
        let mut bytes = if len < LARGE {
            Buffer::from(Vec::with_capacity(len + 3))
        } else {
            self.pool.take(len + 3)
        };
        bytes.clear();
        bytes.extend_from_slice(&cdr::encapsulation(meta.endian, meta.options));
        bytes.extend_from_slice(cdr);
        cdr::pad(&mut bytes);
        *self.taken.lock().unwrap_or_else(PoisonError::into_inner) = Some((meta.endian, bytes));
        Delivery::Taken
    }
}

impl Drive {
    pub(crate) fn open(args: &Args) -> Result<Drive, Failure> {
        let options = DriveOptions { merge: args.merge, ..DriveOptions::default() };
        let mut replay = Replay::open_as(&args.drives, &options).map_err(DriveError)?;
        let start_ns = replay.start_ns().unwrap_or(0);
        // A truncated database does not have it.
        let known_end_ns = replay.end_ns();
        let end_ns = known_end_ns.unwrap_or(start_ns);
        let from_ns = start_ns.saturating_add(args.start);
        let to_ns = args.duration.map_or(i64::MAX, |duration| from_ns.saturating_add(duration));
        if known_end_ns.is_some() && from_ns > end_ns {
            let seconds = end_ns.saturating_sub(start_ns) as f64 / 1e9;
            let message = format!("the drive is only {seconds:.1} s long");
            return Err(Failure::new(Exit::Usage, message).with_help("give a smaller --start"));
        }
        let round_ns = if to_ns <= end_ns {
            to_ns - from_ns
        } else {
            end_ns.saturating_sub(from_ns).saturating_add(GAP_NS)
        };
        begin_at(&mut replay, &args.drives, from_ns);
        let inbox = Arc::new(Inbox { pool: Pool::default(), taken: Mutex::new(None) });
        let (topics, recorded) = subscribe(&mut replay, args, &inbox)?;
        Ok(Drive {
            paths: args.drives.clone(),
            undecodable: vec![0; topics.len()],
            topics,
            recorded,
            replay,
            inbox,
            decoder: Decoder::new(args.size),
            window: (from_ns, to_ns),
            round_ns: args.looped.then_some(round_ns),
            rounds: 0,
            is_alive: false,
        })
    }

    /// Begins the next round; returns false if there is none.
    fn begin_again(&mut self) -> Result<bool, Failure> {
        if self.round_ns.is_none() || !self.is_alive {
            return Ok(false);
        }
        self.replay = Replay::open(&self.paths).map_err(DriveError)?;
        begin_at(&mut self.replay, &self.paths, self.window.0);
        for (spec, _) in &self.recorded {
            let sink: Arc<dyn Sink> = self.inbox.clone();
            self.replay.subscribe(spec, sink).map_err(|error| {
                Failure::caused_by(Exit::Usage, "the drive changed while it was played", &error)
            })?;
        }
        self.is_alive = false;
        self.rounds += 1;
        Ok(true)
    }
}

/// The topics to play, and those of the drive, each with whether its images are decoded.
type SubscribedTopics = (Vec<PlayedTopic>, Vec<(TopicSpec, bool)>);

/// Subscribes the topics to play; returns them, and how the drive has them.
fn subscribe(
    replay: &mut Replay,
    args: &Args,
    inbox: &Arc<Inbox>,
) -> Result<SubscribedTopics, Failure> {
    let mut remaps = Remaps::of(args);
    let (mut topics, mut recorded) = (Vec::<PlayedTopic>::new(), Vec::new());
    for found in wanted(replay, &args.topics)? {
        let decoded =
            args.raw_images && names::dds_type(&found.type_name).as_deref() == Some(COMPRESSED);
        let to = remaps.take(&found.topic);
        let topic = play_as(replay, &found, decoded, to);
        let spec = TopicSpec {
            topic: found.topic.clone(),
            type_name: found.type_name.clone(),
            queue: 1,
            max_bytes: usize::MAX,
            qos: Qos::Auto,
        };
        let subscribed = topic.and_then(|topic| {
            let sink: Arc<dyn Sink> = inbox.clone();
            replay.subscribe(&spec, sink).map(|_| topic).map_err(|error| error.to_string())
        });
        match subscribed {
            Ok(topic) => {
                topics.push(topic);
                recorded.push((spec, decoded));
            }
            // A topic that was requested by name is never skipped.
            Err(why) if args.topics.contains(&found.topic) => {
                return Err(Failure::new(Exit::Usage, why));
            }
            Err(why) => warn(&format!("{why}; the topic is skipped")),
        }
    }
    remaps.check(&topics)?;
    if topics.is_empty() {
        return Err(Failure::new(Exit::Usage, "the drive has no topic that can be played"));
    }
    Ok((topics, recorded))
}

/// Begins a replay at this time, with the latched messages that were valid then.
fn begin_at(replay: &mut Replay, paths: &[PathBuf], from_ns: i64) {
    if replay.start_ns().is_some_and(|start_ns| start_ns < from_ns) {
        replay.restrict(from_ns, i64::MAX);
        replay.begin_with_latched(paths, &DriveOptions::default());
    }
}

/// The DDS name of the type of compressed images.
const COMPRESSED: &str = "sensor_msgs::msg::dds_::CompressedImage_";

fn wanted(replay: &Replay, names: &[String]) -> Result<Vec<DiscoveredTopic>, Failure> {
    let topics = replay.topics();
    if let Some(unknown) =
        names.iter().find(|name| topics.iter().all(|topic| topic.topic != **name))
    {
        // The error lists the topics that exist.
        let error = replay.definitions(unknown).err().map(|error| error.to_string());
        return Err(Failure::new(
            Exit::Usage,
            error.unwrap_or_else(|| format!("no topic `{unknown}`")),
        ));
    }
    Ok(topics
        .into_iter()
        .filter(|topic| names.is_empty() || names.contains(&topic.topic))
        .collect())
}

/// Returns how a topic is played, named `to` if given; or the reason why it cannot be played.
fn play_as(
    replay: &Replay,
    found: &DiscoveredTopic,
    decoded: bool,
    to: Option<&str>,
) -> Result<PlayedTopic, String> {
    let topic = match to {
        Some(to) => to.to_owned(),
        None if decoded => names::image_raw(&found.topic),
        None => found.topic.clone(),
    };
    if names::dds_topic(&topic).is_none() {
        return Err(format!("topic name `{topic}` is not valid in ROS 2"));
    }
    let type_name = if decoded { "sensor_msgs/msg/Image" } else { &found.type_name };
    if names::dds_type(type_name).is_none() {
        return Err(format!(
            "topic `{}` has type `{type_name}`, which is not a ROS 2 type",
            found.topic
        ));
    }
    let is_stamped = decoded
        || replay.definitions(&found.topic).is_ok_and(|definitions| stamp::has_stamp(&definitions));
    let offer = Offer::recorded(found.offered_qos.as_deref()).capped(is_large(type_name));
    Ok(PlayedTopic { topic, type_name: type_name.to_owned(), offer, is_stamped })
}

impl MessageSource for Drive {
    fn topics(&self) -> &[PlayedTopic] {
        &self.topics
    }

    fn next(&mut self) -> Result<Option<QueuedMessage>, Failure> {
        loop {
            let step = match self.replay.step().map_err(DriveError)? {
                Some(step) if step.at_ns < self.window.1 => step,
                _ if self.begin_again()? => continue,
                _ => return Ok(None),
            };
            let taken = self.inbox.taken.lock().unwrap_or_else(PoisonError::into_inner).take();
            let Some((mut endian, mut bytes)) = taken else { continue };
            // Subscription ids follow the order of the topics.
            let topic = step.subscription.0;
            if self.recorded[topic].1 {
                match self.decoder.convert(&bytes[cdr::ENCAPSULATION..], endian) {
                    Ok(image) => (endian, bytes) = (Endian::Little, image),
                    Err(error) => {
                        if self.undecodable[topic] == 0 {
                            let topic = &self.recorded[topic].0.topic;
                            warn(&format!(
                                "cannot decode an image of `{topic}`, skipped: {error}; \
                                 the summary has the count"
                            ));
                        }
                        self.undecodable[topic] += 1;
                        continue;
                    }
                }
            }
            self.is_alive = true;
            let rounds_ns = self.round_ns.unwrap_or(0).saturating_mul(self.rounds);
            let at_ns = step.at_ns.saturating_sub(self.window.0).saturating_add(rounds_ns);
            return Ok(Some(QueuedMessage { topic, at_ns, rounds_ns, endian, bytes }));
        }
    }

    fn read_ahead(&self) -> usize {
        256 << 20
    }

    fn undecodable(&self, topic: usize) -> u64 {
        self.undecodable[topic]
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use gleaner_messages::ImageView;

    use super::*;

    /// 40 s of a camera at 10 Hz, an IMU at 100 Hz, and a speed topic.
    const SAMPLE: &str =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/data/highway_drive.mcap");

    fn open(arguments: &[&str]) -> Result<Drive, Failure> {
        let line = ["gleaner-player", SAMPLE].into_iter().chain(arguments.iter().copied());
        Drive::open(&Args::try_parse_from(line).unwrap())
    }

    fn names(drive: &Drive) -> Vec<&str> {
        drive.topics().iter().map(|topic| topic.topic.as_str()).collect()
    }

    fn refused(arguments: &[&str]) -> Failure {
        open(arguments).err().expect("the arguments are refused")
    }

    #[test]
    fn all_messages_of_a_drive_are_played_in_order_from_time_0() {
        let mut drive = open(&[]).unwrap();
        assert_eq!(names(&drive), ["/camera/front/compressed", "/imu/data", "/vehicle/speed"]);
        assert!(drive.topics().iter().all(|topic| topic.is_stamped));
        let messages: Vec<_> = std::iter::from_fn(|| drive.next().unwrap()).collect();
        assert_eq!(messages.len(), 400 + 4170 + 3316);
        assert_eq!(messages[0].at_ns, 0);
        assert!(messages.is_sorted_by_key(|message| message.at_ns));
        assert!(
            messages
                .iter()
                .all(|message| message.bytes.len() % 4 == 0 && message.bytes[..4] == [0, 1, 0, 0])
        );
    }

    #[test]
    fn a_part_of_a_drive_begins_at_time_0_and_ends_before_its_end() {
        let mut drive =
            open(&["--topics", "/imu/data", "--start", "10", "--duration", "2"]).unwrap();
        assert_eq!(names(&drive), ["/imu/data"]);
        let times: Vec<_> =
            std::iter::from_fn(|| drive.next().unwrap()).map(|message| message.at_ns).collect();
        assert!((190..220).contains(&times.len()), "{}", times.len());
        assert!(
            times[0] < 20_000_000 && times.iter().all(|at_ns| (0..2_000_000_000).contains(at_ns))
        );
    }

    #[test]
    fn rounds_repeat_without_end_and_time_never_goes_back() {
        let mut drive = open(&["--topics", "/imu/data", "--start", "39", "--loop"]).unwrap();
        let messages: Vec<_> = std::iter::from_fn(|| drive.next().unwrap()).take(1000).collect();
        assert_eq!(messages.len(), 1000);
        assert!(messages.is_sorted_by(|a, b| a.at_ns < b.at_ns));
        let rounds: std::collections::BTreeSet<_> =
            messages.iter().map(|message| message.rounds_ns).collect();
        let rounds: Vec<_> = rounds.into_iter().collect();
        assert!(rounds.len() > 5 && rounds[0] == 0);
        assert!(rounds.windows(2).all(|pair| pair[1] - pair[0] == rounds[1]));
    }

    #[test]
    fn compressed_images_become_raw_ones_under_another_name() {
        let arguments = ["--topics", "/camera/front/compressed", "--raw-images", "--size", "64x36"];
        let mut drive = open(&arguments).unwrap();
        assert_eq!(names(&drive), ["/camera/front/image_raw"]);
        assert_eq!(drive.topics()[0].type_name, "sensor_msgs/msg/Image");
        let message = drive.next().unwrap().unwrap();
        let image = ImageView::read(&message.bytes[4..], message.endian).unwrap();
        assert_eq!(
            (image.width, image.height, image.encoding, image.data.len()),
            (64, 36, "bgr8", 64 * 36 * 3)
        );
        assert_eq!(drive.undecodable(0), 0);
    }

    #[test]
    fn topics_are_renamed_and_invalid_arguments_are_refused() {
        assert!(names(&open(&["--remap", "/imu/data:=/car/imu"]).unwrap()).contains(&"/car/imu"));
        let remaps = ["--raw-images", "--remap", "/camera/front/compressed:=/front"];
        assert!(names(&open(&remaps).unwrap()).contains(&"/front"));
        for (arguments, expected) in [
            (&["--topics", "/imu/dat"][..], "/imu/data"),
            (&["--remap", "/nothing:=/x"], "which is not played"),
            (&["--remap", "/imu/data:=/vehicle/speed"], "two topics"),
            (&["--start", "41"], "40.0 s long"),
        ] {
            let failure = refused(arguments);
            assert_eq!(failure.exit, Exit::Usage);
            assert!(failure.message.contains(expected), "{failure}");
        }
    }
}
