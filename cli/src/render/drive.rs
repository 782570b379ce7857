//! Formats the contents of a drive, and `[[input]]` tables for a manifest.

use std::collections::HashSet;
use std::fmt::Write;

use gleaner_base::visible;
use gleaner_lambda::manifest::{TopicName, TypeName};
use gleaner_protocol::{DriveInfo, DriveTopicInfo, PictureInfo};
use gleaner_report::format::{counted, grouped, seconds, size};

use super::live::table;

/// Words of topic names that do not describe the measured quantity.
const EMPTY_WORDS: [&str; 7] =
    ["data", "raw", "image", "image_raw", "image_color", "compressed", "msg"];

/// Formats the length of the drive, a table of its topics, and `[[input]]` tables.
pub(crate) fn drive(drive: &DriveInfo) -> String {
    let Some(start) = drive.start_ns else {
        return match &drive.damaged {
            Some(damaged) => format!("no messages: {}\n", visible(damaged)),
            None => "no messages\n".to_owned(),
        };
    };
    let (whole, rest) = (start.div_euclid(1_000_000_000), start.rem_euclid(1_000_000_000));
    // Unknown for a truncated database, and after a message without a possible time.
    let length = drive
        .end_ns
        .map_or("length unknown".to_owned(), |end| format!("{:.3} s", seconds(end, start)));
    let mut text = format!("{length}, starts at @{whole}.{rest:09}\n");
    if !drive.parts.is_empty() {
        let parts = drive.parts.iter().map(|[from, to]| {
            format!("{:.1} to {:.1} s", seconds(*from, start), seconds(*to, start))
        });
        let parts = parts.collect::<Vec<_>>().join(", ");
        // Writing to a string cannot fail, here and below.
        let _ =
            writeln!(text, "rates, gaps and sizes are from {parts}; --all reads the whole drive");
    }
    if let Some(damaged) = &drive.damaged {
        let _ = writeln!(text, "{}", visible(damaged));
    }
    if drive.out_of_order > 0 {
        let _ =
            writeln!(text, "{} out of order by log time", counted(drive.out_of_order, "message"));
    }
    let head = ["topic", "type", "messages", "Hz", "longest gap", "at", "missing", "largest", ""];
    let rows = drive.topics.iter().map(|topic| row(topic, start));
    text += &table(&head, rows, &[2, 3, 4, 5, 6, 7]);
    if drive.skipped > 0 {
        let _ = writeln!(text, "and {}, not read", counted(drive.skipped, "more topic"));
    }
    text + &inputs(&drive.topics)
}

fn row(topic: &DriveTopicInfo, start_ns: i64) -> [String; 9] {
    let unknown = || "?".to_owned();
    let notes = [
        topic.picture.as_ref().map(picture_text),
        topic.unreadable.as_deref().map(visible).or_else(|| {
            (!topic.is_defined).then(|| "no definition: read as bytes only".to_owned())
        }),
        (topic.layouts > 1).then(|| format!("{} layouts of its type", topic.layouts)),
        (topic.malformed > 0).then(|| format!("{} malformed, left out", grouped(topic.malformed))),
    ];
    [
        visible(&topic.topic),
        visible(&topic.type_name),
        topic.messages.map_or_else(unknown, grouped),
        rate_hz(topic).map_or_else(unknown, |hz| format!("{hz:.1}")),
        topic
            .interval
            .map_or_else(unknown, |interval| format!("{:.1} ms", interval.max_ns as f64 / 1e6)),
        topic
            .longest_gap_at_ns
            .map_or_else(unknown, |at| format!("{:.3} s", seconds(at, start_ns))),
        topic.missing.map_or_else(unknown, grouped),
        if topic.messages_read > 0 { size(topic.largest_bytes) } else { unknown() },
        notes.into_iter().flatten().collect::<Vec<_>>().join("; "),
    ]
}

fn picture_text(picture: &PictureInfo) -> String {
    format!("{} {}x{}", visible(&picture.encoding), picture.width, picture.height)
}

/// Returns the rate by the median interval, which gaps do not change.
fn rate_hz(topic: &DriveTopicInfo) -> Option<f64> {
    topic
        .interval
        .filter(|interval| interval.p50_ns > 0)
        .map(|interval| 1e9 / interval.p50_ns as f64)
}

/// Writes an `[[input]]` table for each topic whose fields can be read.
fn inputs(topics: &[DriveTopicInfo]) -> String {
    let (mut text, mut names) = (String::new(), HashSet::new());
    for topic in topics
        .iter()
        .filter(|topic| topic.is_defined && topic.unreadable.is_none() && topic.messages_read > 0)
        .filter(|topic| topic.type_name.parse::<TypeName>().is_ok() && !topic.topic.is_empty())
    {
        let base = name_of(&topic.topic);
        let others = (2..).map(|n| format!("{base}_{n}"));
        let name = std::iter::once(base.clone())
            .chain(others)
            .find(|name| !names.contains(name))
            .unwrap_or_default();
        let (mut shown, mut remark) = (visible(&topic.topic), String::new());
        if topic.topic.parse::<TopicName>().is_err() {
            remark = format!("# not a name of a ROS 2 topic; pass --remap '/{name}:={shown}'\n");
            shown = format!("/{name}");
        }
        let type_name = visible(&topic.type_name);
        let _ = write!(
            text,
            "\n{remark}[[input]]\nname = \"{name}\"\ntopic = \"{shown}\"\ntype = \"{type_name}\"\n",
        );
        names.insert(name);
        text += &sizes(topic);
    }
    if text.is_empty() { text } else { format!("\nfor lambda.toml:\n{text}") }
}

/// Returns the keys of an `[[input]]` table that differ from the defaults, with reserves.
fn sizes(topic: &DriveTopicInfo) -> String {
    let kib = |bytes: u64| format!("{} KiB", bytes.div_ceil(1024));
    if let Some(PictureInfo { width, height, is_compressed, .. }) = &topic.picture {
        // Width and height are untrusted.
        let decoded = 3_u64.saturating_mul(u64::from(*width)).saturating_mul(u64::from(*height));
        return match is_compressed {
            true => format!(
                "max_size = \"{}\"\ndecoded_size = \"{}\"\n",
                kib(topic.largest_bytes.saturating_mul(2).next_power_of_two()),
                kib(decoded)
            ),
            false => format!("max_size = \"{}\"\n", kib(topic.largest_bytes.saturating_add(1024))),
        };
    }
    let mut text = String::new();
    if let Some(hz) = rate_hz(topic) {
        let depth = (hz.ceil() as usize).next_power_of_two().clamp(8, 4096);
        let _ = writeln!(text, "depth = {depth:<20}# {:.1} s", depth as f64 / hz);
    }
    if topic.largest_bytes > 4096 {
        let _ = writeln!(
            text,
            "max_size = \"{}\"",
            kib(topic.largest_bytes.saturating_mul(2).next_power_of_two())
        );
    }
    text
}

/// Makes a name for an input from the words of its topic.
fn name_of(topic: &str) -> String {
    let words = topic.split('/').filter(|word| !word.is_empty() && !EMPTY_WORDS.contains(word));
    let words = words.map(str::to_ascii_lowercase).collect::<Vec<_>>();
    let name = words[words.len().saturating_sub(2)..].join("_");
    let name: String =
        name.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '_').take(48).collect();
    if name.starts_with(|first: char| first.is_ascii_lowercase()) {
        name
    } else {
        format!("input{name}")
    }
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::DurationStats;

    use super::*;

    fn topic(topic: &str) -> DriveTopicInfo {
        let ms = |ms: u64| ms * 1_000_000;
        DriveTopicInfo {
            topic: topic.to_owned(),
            type_name: "sensor_msgs/msg/Imu".to_owned(),
            messages: Some(12_345),
            is_defined: true,
            layouts: 1,
            messages_read: 12_345,
            interval: Some(DurationStats {
                n: 12_344,
                p50_ns: ms(10),
                p99_ns: ms(11),
                max_ns: ms(52),
            }),
            longest_gap_at_ns: Some(1_500_000_001_250_000_000),
            missing: Some(0),
            largest_bytes: 324,
            bytes: 324 * 12_345,
            ..DriveTopicInfo::default()
        }
    }

    fn seen(topics: Vec<DriveTopicInfo>) -> DriveInfo {
        let [start_ns, end_ns] = [1_500_000_000_250_000_000, 1_500_000_002_000_000_000].map(Some);
        DriveInfo { start_ns, end_ns, topics, ..DriveInfo::default() }
    }

    #[test]
    fn a_drive_is_shown_with_a_table_of_inputs() {
        let unknown = DriveTopicInfo {
            messages: None,
            is_defined: false,
            messages_read: 0,
            interval: None,
            longest_gap_at_ns: None,
            missing: None,
            ..topic("/other")
        };
        let expected = "1.750 s, starts at @1500000000.250000000
topic      type                 messages     Hz  longest gap       at  missing  largest
/imu/data  sensor_msgs/msg/Imu    12,345  100.0      52.0 ms  1.000 s        0    324 B
/other     sensor_msgs/msg/Imu         ?      ?            ?        ?        ?        ?  no definition: read as bytes only

for lambda.toml:

[[input]]
name = \"imu\"
topic = \"/imu/data\"
type = \"sensor_msgs/msg/Imu\"
depth = 128                 # 1.3 s
";
        assert_eq!(drive(&seen(vec![topic("/imu/data"), unknown])), expected);
        assert_eq!(drive(&DriveInfo { start_ns: None, ..seen(Vec::new()) }), "no messages\n");
        let endless = drive(&DriveInfo { end_ns: None, ..seen(Vec::new()) });
        assert!(endless.starts_with("length unknown, starts at @1500000000.250000000\n"));
        let damaged = Some("cut off".to_owned());
        assert_eq!(
            drive(&DriveInfo { start_ns: None, damaged, ..seen(Vec::new()) }),
            "no messages: cut off\n"
        );
    }

    #[test]
    fn sizes_fit_the_pictures() {
        let shape = |is_compressed| PictureInfo {
            encoding: "x".to_owned(),
            width: 1280,
            height: 720,
            is_compressed,
        };
        let camera = |is_compressed, largest_bytes| DriveTopicInfo {
            picture: Some(shape(is_compressed)),
            largest_bytes,
            ..topic("/camera/front/compressed")
        };
        assert_eq!(
            sizes(&camera(true, 41_000)),
            "max_size = \"128 KiB\"\ndecoded_size = \"2700 KiB\"\n"
        );
        assert_eq!(sizes(&camera(false, 2_764_900)), "max_size = \"2702 KiB\"\n");
        for is_compressed in [true, false] {
            let picture = PictureInfo { width: u32::MAX, height: u32::MAX, ..shape(is_compressed) };
            let camera = DriveTopicInfo { picture: Some(picture), ..camera(is_compressed, 1024) };
            assert!(sizes(&camera).starts_with("max_size = \"2 KiB\"\n"));
        }
    }

    #[test]
    fn names_are_valid_and_unique() {
        for (topic, name) in [
            ("/imu/data", "imu"),
            ("/camera/front/compressed", "camera_front"),
            ("/a/b/c/Raw_Points", "c_raw_points"),
            ("/data", "input"),
            ("/_hidden", "input_hidden"),
        ] {
            assert_eq!(name_of(topic), name);
            assert!(name.parse::<gleaner_lambda::manifest::ItemName>().is_ok());
        }
        let text = inputs(&[topic("/imu/data"), topic("/imu/raw"), topic("/imu")]);
        assert!(
            ["\"imu\"", "\"imu_2\"", "\"imu_3\""].iter().all(|name| text.contains(name)),
            "{text}"
        );
    }

    #[test]
    fn unread_and_damaged_parts_are_reported() {
        let drive_of_parts = DriveInfo {
            parts: vec![[1_500_000_000_250_000_000, 1_500_000_000_750_000_000]],
            damaged: Some("cut\u{1b} off".to_owned()),
            out_of_order: 2,
            skipped: 61_439,
            ..seen(Vec::new())
        };
        let text = drive(&drive_of_parts);
        assert!(text.contains("from 0.0 to 0.5 s; --all reads the whole drive\n"), "{text}");
        assert!(text.contains("cut\\u{1b} off\n2 messages out of order"), "{text}");
        assert!(text.ends_with("\nand 61,439 more topics, not read\n"), "{text}");
    }
}
