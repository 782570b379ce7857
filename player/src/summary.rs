//! Formats the summary, as text and as JSON.

use serde_json::{Value, json};

use crate::counts::TopicCounts;
use crate::source::PlayedTopic;

pub(crate) struct TopicSummary<'t> {
    pub(crate) topic: &'t PlayedTopic,
    pub(crate) counts: TopicCounts,
    pub(crate) undecodable: u64,
    /// Maximum number of readers at the same time.
    pub(crate) readers: usize,
}

/// The summary as a JSON object, all times in ns.
pub(crate) fn json(lines: &[TopicSummary<'_>], seconds: f64) -> Value {
    let topics: Vec<Value> = lines
        .iter()
        .map(|line| {
            let TopicCounts { sent, bytes, refused, late, latest_ns, unstamped, writes } =
                &line.counts;
            json!({
                "topic": line.topic.topic,
                "type": line.topic.type_name,
                "reliable": line.topic.offer.reliable,
                "transient_local": line.topic.offer.transient_local,
                "depth": line.topic.offer.depth,
                "sent": sent,
                "bytes": bytes,
                "late": late,
                "latest_ns": latest_ns,
                "refused": refused,
                "undecodable": line.undecodable,
                "unstamped": unstamped,
                "write_p50_ns": writes.median_ns(),
                "write_max_ns": writes.longest_ns(),
                "readers": line.readers,
            })
        })
        .collect();
    json!({ "seconds": seconds, "topics": topics })
}

/// The summary as a table, followed by the losses.
pub(crate) fn text(lines: &[TopicSummary<'_>], seconds: f64) -> String {
    let sent: u64 = lines.iter().map(|line| line.counts.sent).sum();
    let bytes: u64 = lines.iter().map(|line| line.counts.bytes).sum();
    let rate = bytes as f64 / 1e6 / seconds.max(1e-9);
    let mut text = format!(
        "sent {sent} messages, {:.1} MB, in {seconds:.1} s: {rate:.1} MB/s\n",
        bytes as f64 / 1e6
    );
    let width = lines.iter().map(|line| line.topic.topic.len()).max().unwrap_or(0).max(5);
    text += &format!(
        "{:width$}  {:>9} {:>10} {:>7} {:>8} {:>12} {:>10}\n",
        "topic", "sent", "MB", "late", "readers", "write median", "write max"
    );
    for line in lines {
        let counts = &line.counts;
        text += &format!(
            "{:width$}  {:>9} {:>10.1} {:>7} {:>8} {:>12} {:>10}\n",
            line.topic.topic,
            counts.sent,
            counts.bytes as f64 / 1e6,
            counts.late,
            line.readers,
            duration(counts.writes.median_ns()),
            duration(counts.writes.longest_ns()),
        );
    }
    for line in lines {
        let (topic, counts) = (&line.topic.topic, &line.counts);
        let losses = [
            (counts.refused, "were not sent: readers were too slow".to_owned()),
            (line.undecodable, "were skipped: their images cannot be decoded".to_owned()),
            (counts.unstamped, "were sent unchanged: they are too short for a stamp".to_owned()),
            (
                counts.late,
                format!("were late, by up to {}", duration(counts.latest_ns.unsigned_abs())),
            ),
        ];
        for (count, what) in losses.iter().filter(|(count, _)| *count > 0) {
            text += &format!("{topic}: {count} messages {what}\n");
        }
    }
    text
}

fn duration(ns: u64) -> String {
    match ns {
        0..1_000_000 => format!("{:.1} us", ns as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} ms", ns as f64 / 1e6),
        _ => format!("{:.1} s", ns as f64 / 1e9),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offer::Offer;

    #[test]
    fn every_loss_is_in_the_text_and_in_the_json() {
        let topic = PlayedTopic {
            topic: "/camera/front".to_owned(),
            type_name: "sensor_msgs/msg/Image".to_owned(),
            offer: Offer::default(),
            is_stamped: true,
        };
        let mut counts = TopicCounts {
            sent: 7,
            bytes: 7_000_000,
            refused: 3,
            late: 2,
            latest_ns: 12_000_000,
            unstamped: 1,
            ..TopicCounts::default()
        };
        counts.writes.add(1_500_000);
        let lines = [TopicSummary { topic: &topic, counts, undecodable: 4, readers: 1 }];
        let text = text(&lines, 2.0);
        for expected in [
            "3.5 MB/s",
            "1.5 ms",
            "3 messages were not sent",
            "4 messages were skipped",
            "by up to 12.0 ms",
            "1 messages were sent unchanged",
        ] {
            assert!(text.contains(expected), "{expected}: {text}");
        }
        let object = json(&lines, 2.0);
        let line = &object["topics"][0];
        assert_eq!(
            [&line["sent"], &line["refused"], &line["undecodable"], &line["late"]],
            [7, 3, 4, 2]
        );
        assert_eq!((&line["write_max_ns"], &line["unstamped"]), (&json!(1_500_000), &json!(1)));
    }
}
