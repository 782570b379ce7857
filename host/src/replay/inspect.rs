//! `gleaner-runtime inspect`: reports the content of a recorded drive, without a lambda.

use std::collections::HashMap;
use std::io::Write;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_drives::{DriveOptions, Replay, ReplayError, ReplayStep, files_of};
use gleaner_messages::transport::{
    Delivery, DiscoveredTopic, Gaps, Qos, SampleMeta, Sink, TopicSpec, Transport,
};
use gleaner_messages::{CompressedView, ImageView, Sources};
use gleaner_protocol::process_stats::Durations;
use gleaner_protocol::{DriveInfo, DriveTopicInfo, DurationStats, PictureInfo, Report};

use super::open::{self, DriveError};
use super::reports::send;
use crate::isolation::definition_dirs;

/// Size in bytes above which only parts of a drive are read; this much takes about a second.
const WHOLE_BYTES: u64 = 256 << 20;
/// Number of parts of a large drive: its beginning, its middle and its end.
const PARTS: i64 = 3;
const PART_NS: i64 = 2_000_000_000;
/// Bytes of messages after which a part ends early.
const PART_BYTES: u64 = 64 << 20;
/// Size in bytes of the largest message that is unpacked.
const LARGEST: usize = 256 << 20;
/// Maximum number of topics. A vehicle has some hundreds; a file can name 65,536.
const TOPICS: usize = 4096;

/// Arguments of `inspect`.
#[derive(Args, Clone, Debug)]
pub struct InspectArgs {
    /// MCAP files, databases and directories of rosbag2.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// Read the whole drive, whatever its size.
    #[arg(long)]
    pub all: bool,
    /// Merge all files by time, even if they are separate drives.
    #[arg(long)]
    pub merge: bool,
}

/// Reads the drives and reports their content.
pub fn inspect(args: &InspectArgs, reports: &mut dyn Write) -> Result<Exit, Failure> {
    let mut options = DriveOptions {
        sources: Some(Sources::new(&[], &definition_dirs())),
        merge: args.merge,
        ..DriveOptions::default()
    };
    let mut drive = match Replay::open_as(&args.drives, &options) {
        Err(ReplayError::Separate { drives }) if open::are_text(&drives) => {
            send(reports, &Report::Separate { drives });
            return Ok(Exit::Ok);
        }
        drive => drive.map_err(DriveError)?,
    };
    // A file that grows may become another drive.
    options.merge = true;
    let open = || Replay::open_as(&args.drives, &options).map_err(DriveError);
    let (start_ns, end_ns) = (drive.start_ns(), drive.end_ns());
    let (mut topics, skipped) = inspections(drive.topics());
    let mut parts = if args.all || bytes(&args.drives)? <= WHOLE_BYTES {
        Vec::new()
    } else {
        spread(start_ns, end_ns)
    };
    let (mut damaged, mut out_of_order) = (None, 0);
    if parts.is_empty() {
        damaged = read(&mut drive, &mut topics, None).1;
        out_of_order = drive.out_of_order();
        count_malformed(&drive, &mut topics);
    }
    for (n, part) in parts.iter_mut().enumerate() {
        if n > 0 {
            drive = open()?;
        }
        drive.restrict(part[0], part[1]);
        let (until_ns, broken) = read(&mut drive, &mut topics, Some(PART_BYTES));
        part[1] = until_ns.unwrap_or(part[1]);
        out_of_order += drive.out_of_order();
        count_malformed(&drive, &mut topics);
        damaged = damaged.or(broken);
    }
    let mut topics: Vec<_> = topics.into_iter().map(TopicInspection::into_info).collect();
    // A writer that numbers the messages of all topics together leaves gaps in each topic, one for
    // each message of the others.
    let (read, missing) = topics.iter().fold((0, 0), |(read, missing), topic| {
        (read + topic.messages_read, topic.missing.unwrap_or(0).saturating_add(missing))
    });
    if missing > read / 2 {
        topics.iter_mut().for_each(|topic| topic.missing = None);
    }
    let info = DriveInfo { start_ns, end_ns, parts, out_of_order, damaged, topics, skipped };
    send(reports, &Report::Drive(info));
    Ok(Exit::Ok)
}

/// Adds the messages that a drive left out; those of a topic with several types to the first.
fn count_malformed(drive: &Replay, topics: &mut [TopicInspection]) {
    for (name, messages) in drive.malformed() {
        if let Some(topic) = topics.iter_mut().find(|topic| topic.info.topic == *name) {
            topic.info.malformed += messages;
        }
    }
}

/// Returns the topics to inspect, by name, and the number of those left out; topics without
/// messages are left out first.
fn inspections(mut found: Vec<DiscoveredTopic>) -> (Vec<TopicInspection>, u64) {
    let skipped = found.len().saturating_sub(TOPICS);
    if skipped > 0 {
        found.sort_by_key(|topic| topic.messages == Some(0));
        found.truncate(TOPICS);
        found.sort_by(|a, b| a.topic.cmp(&b.topic));
    }
    (found.into_iter().map(TopicInspection::new).collect(), skipped as u64)
}

fn bytes(drives: &[PathBuf]) -> Result<u64, DriveError> {
    let files = files_of(drives).map_err(DriveError)?;
    Ok(files.iter().filter_map(|file| file.metadata().ok()).map(|data| data.len()).sum())
}

/// The parts of a large drive; none if it is shorter than all parts together.
fn spread(start_ns: Option<i64>, end_ns: Option<i64>) -> Vec<[i64; 2]> {
    let (Some(start), Some(end)) = (start_ns, end_ns) else { return Vec::new() };
    let length = end.saturating_sub(start);
    if length <= PARTS * PART_NS {
        return Vec::new();
    }
    // The end of a part is exclusive, and the last part is to contain the last message.
    let room = i128::from(length) + 1 - i128::from(PART_NS);
    let from = |n: i64| start + (room * i128::from(n) / i128::from(PARTS - 1)) as i64;
    (0..PARTS).map(|n| [from(n), from(n).saturating_add(PART_NS)]).collect()
}

/// Reads the range to which `drive` is restricted, at most `most` bytes of messages. Returns the
/// end of the part that was read, if it ended early, and the damage, if there is any.
fn read(
    drive: &mut Replay,
    topics: &mut [TopicInspection],
    most: Option<u64>,
) -> (Option<i64>, Option<String>) {
    let mut subscribed = HashMap::new();
    for (index, topic) in topics.iter_mut().enumerate() {
        topic.begin();
        match drive.subscribe(&topic.spec(), topic.first.clone()) {
            Ok(subscription) => drop(subscribed.insert(subscription, index)),
            Err(error) => topic.info.unreadable = Some(error.to_string()),
        }
    }
    let mut bytes = 0;
    loop {
        match drive.step() {
            Ok(Some(step)) => {
                if let Some(index) = subscribed.get(&step.subscription) {
                    topics[*index].add(&step);
                }
                bytes += step.bytes as u64;
                if most.is_some_and(|most| bytes >= most) {
                    return (Some(step.at_ns.saturating_add(1)), None);
                }
            }
            Ok(None) => return (None, None),
            Err(error) => return (None, Some(error.to_string())),
        }
    }
}

struct TopicInspection {
    info: DriveTopicInfo,
    first: Arc<FirstMessage>,
    /// Set from the second message on: most topics of a file may have none.
    intervals: Option<Durations>,
    longest_ns: i64,
    /// Stamp of the last message of this part.
    last_ns: Option<i64>,
    gaps: Gaps,
}

impl TopicInspection {
    fn new(found: DiscoveredTopic) -> Self {
        let first = FirstMessage { type_name: found.type_name.clone(), picture: Mutex::new(None) };
        let info = DriveTopicInfo {
            topic: found.topic,
            type_name: found.type_name,
            messages: found.messages,
            is_defined: found.definitions_text.is_some(),
            layouts: u64::from(found.definitions_text.is_some())
                + found.other_definitions.len() as u64,
            malformed: 0,
            unreadable: None,
            messages_read: 0,
            interval: None,
            longest_gap_at_ns: None,
            missing: Some(0),
            largest_bytes: 0,
            bytes: 0,
            picture: None,
        };
        let (first, gaps) = (Arc::new(first), Gaps::default());
        Self { info, first, intervals: None, longest_ns: -1, last_ns: None, gaps }
    }

    fn spec(&self) -> TopicSpec {
        let DriveTopicInfo { topic, type_name, .. } = &self.info;
        let (topic, type_name) = (topic.clone(), type_name.clone());
        TopicSpec { topic, type_name, queue: 1, max_bytes: LARGEST, qos: Qos::Auto }
    }

    /// Begins another part: the time between two parts is no gap.
    fn begin(&mut self) {
        self.last_ns = None;
        self.info.missing = self
            .info
            .missing
            .map(|missing| missing.saturating_add(std::mem::take(&mut self.gaps).lost()));
    }

    fn add(&mut self, step: &ReplayStep) {
        if step.delivery == Delivery::Malformed {
            return;
        }
        self.info.messages_read += 1;
        self.info.bytes += step.bytes as u64;
        self.info.largest_bytes = self.info.largest_bytes.max(step.bytes as u64);
        self.gaps.note(step.meta.writer, step.meta.seq);
        if let Some(last) = self.last_ns {
            let interval = step.at_ns.saturating_sub(last);
            self.intervals.get_or_insert_default().add(interval);
            if interval > self.longest_ns {
                self.longest_ns = interval;
                self.info.longest_gap_at_ns = Some(last);
            }
        }
        self.last_ns = Some(step.at_ns);
    }

    fn into_info(mut self) -> DriveTopicInfo {
        self.begin();
        let picture = self.first.picture.lock().unwrap_or_else(PoisonError::into_inner).take();
        // The histogram keeps two digits, and no more than a day.
        let max_ns = u64::try_from(self.longest_ns).unwrap_or(0);
        let interval = self
            .intervals
            .as_ref()
            .and_then(Durations::all)
            .map(|kept| DurationStats { max_ns, ..kept });
        DriveTopicInfo { interval, picture: picture.flatten(), ..self.info }
    }
}

/// Inspects the first message of a topic.
struct FirstMessage {
    type_name: String,
    /// `None` before the first message.
    picture: Mutex<Option<Option<PictureInfo>>>,
}

impl Sink for FirstMessage {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let mut picture = self.picture.lock().unwrap_or_else(PoisonError::into_inner);
        picture.get_or_insert_with(|| self.picture(meta, cdr));
        Delivery::Taken
    }
}

impl FirstMessage {
    fn picture(&self, meta: &SampleMeta, cdr: &[u8]) -> Option<PictureInfo> {
        match self.type_name.as_str() {
            "sensor_msgs/msg/Image" => {
                let ImageView { width, height, encoding, .. } =
                    ImageView::read(cdr, meta.endian).ok()?;
                Some(PictureInfo {
                    encoding: encoding.to_owned(),
                    width,
                    height,
                    is_compressed: false,
                })
            }
            "sensor_msgs/msg/CompressedImage" => {
                let view = CompressedView::read(cdr, meta.endian).ok()?;
                let (header, _) = gleaner_pixels::probe_message(view.format, view.data).ok()?;
                let encoding = header.format.to_string();
                Some(PictureInfo {
                    encoding,
                    width: header.width,
                    height: header.height,
                    is_compressed: true,
                })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_of_a_long_drive_hold_its_first_and_its_last_message() {
        let second = 1_000_000_000;
        let parts = spread(Some(7), Some(7 + 100 * second));
        assert_eq!(parts.len(), 3);
        assert!(parts[0][0] == 7 && parts[2][1] > 7 + 100 * second, "{parts:?}");
        assert!(parts.array_windows().all(|[a, b]| a[1] < b[0]));
        assert!(parts.iter().all(|part| part[1] - part[0] == PART_NS));
        assert_eq!(spread(Some(0), Some(5 * second)), Vec::<[i64; 2]>::new());
        assert_eq!(spread(None, None), Vec::<[i64; 2]>::new());
        let to_the_end = spread(Some(7), Some(i64::MAX));
        assert_eq!((to_the_end.len(), to_the_end[2][1]), (3, i64::MAX));
    }
}
