//! Formats the status of the ingress: topics, network, memory.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_protocol::NetworkStatus;
use gleaner_protocol::ingress::{IngressStatus, IngressTopic};
use gleaner_report::format::{counted, grouped};

use super::live::{table, write_indented};
use super::{Paint, mib, written};

pub(crate) fn ingress(status: &IngressStatus, paint: Paint) -> String {
    written(|text| write_ingress(text, status, paint))
}

fn write_ingress(text: &mut String, status: &IngressStatus, paint: Paint) -> fmt::Result {
    let network = status.health.network.as_ref();
    let domain = network.map(|network| format!(", domain {}", network.domain)).unwrap_or_default();
    let readers = counted(status.readers as u64, "reader");
    writeln!(text, "{}{domain}: {readers}", paint.bold("ingress"))?;
    if !status.topics.is_empty() {
        let rows = status.topics.iter().map(row);
        write_indented(text, &table(&HEAD, rows, &[1, 2, 3, 4, 5, 6, 7]))?;
    }
    for warning in status.topics.iter().flat_map(|topic| &topic.reception.qos_warnings) {
        writeln!(text, "  {}", paint.yellow(&visible(warning)))?;
    }
    if let Some(why) = &status.health.dead {
        writeln!(text, "  {}", paint.red(&visible(why)))?;
    }
    if let Some(network) = network {
        write_network(text, network, paint)?;
    }
    let reserved = status.topics.iter().map(|topic| topic.reserved_bytes).sum();
    let line = format!(
        "{:.1} MiB reserved for samples, {:.1} MiB resident, {:.1} s of CPU time",
        mib(reserved),
        mib(status.rss_bytes),
        status.cpu_s,
    );
    writeln!(text, "  {}", paint.dim(&line))
}

const HEAD: [&str; 8] =
    ["topic", "readers", "writers", "received", "lost", "before match", "too big", "malformed"];

fn row(topic: &IngressTopic) -> [String; 8] {
    let unknown = || "?".to_owned();
    let reception = &topic.reception;
    [
        visible(&topic.topic),
        topic.readers.to_string(),
        reception.writers.map_or_else(unknown, |writers| writers.to_string()),
        grouped(topic.received),
        reception.lost.map_or_else(unknown, grouped),
        reception.before_match.map_or_else(unknown, grouped),
        grouped(topic.too_big),
        grouped(reception.malformed),
    ]
}

fn write_network(text: &mut String, network: &NetworkStatus, paint: Paint) -> fmt::Result {
    let losses = [
        (network.socket_drops, "dropped: socket buffer full"),
        (network.filtered, "dropped: too large fragments, or fragments of unknown participants"),
    ];
    for (count, why) in losses.into_iter().filter(|(count, _)| *count > 0) {
        let line = format!("lost: {}, {why}", counted(count, "datagram"));
        writeln!(text, "  {}", paint.yellow(&line))?;
    }
    if let Some(why) = &network.unfiltered {
        writeln!(text, "  {}", paint.yellow(&visible(why)))?;
    }
    let line = format!(
        "{}, socket buffer {:.1} of {:.1} MiB requested{}",
        counted(network.participants as u64, "participant"),
        mib(network.buffer_granted as u64),
        mib(network.buffer_requested as u64),
        if network.real_time { ", real-time priority" } else { "" },
    );
    writeln!(text, "  {}", paint.dim(&line))
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::ingress::{Health, ReceptionStatus};

    use super::*;

    #[test]
    fn losses_of_topics_and_of_the_network_are_shown() {
        let network = NetworkStatus {
            domain: 7,
            participants: 2,
            buffer_requested: 8 << 20,
            buffer_granted: 1 << 20,
            real_time: true,
            socket_drops: 3,
            filtered: 1,
            unfiltered: Some("no filter here".to_owned()),
        };
        let topic = IngressTopic {
            topic: "/imu\u{1b}".to_owned(),
            readers: 2,
            received: 1000,
            too_big: 4,
            reserved_bytes: 3 << 20,
            reception: ReceptionStatus {
                writers: Some(1),
                lost: Some(5),
                before_match: Some(6),
                qos_warnings: vec!["a writer is best effort".to_owned()],
                ..ReceptionStatus::default()
            },
            ..IngressTopic::default()
        };
        let status = IngressStatus {
            health: Health { network: Some(network), dead: None },
            topics: vec![topic],
            readers: 3,
            rss_bytes: 5 << 20,
            cpu_s: 1.0,
        };
        assert_eq!(
            ingress(&status, Paint { on: false }).lines().collect::<Vec<_>>(),
            [
                "ingress, domain 7: 3 readers",
                "  topic       readers  writers  received  lost  before match  too big  malformed",
                "  /imu\\u{1b}        2        1     1,000     5             6        4          0",
                "  a writer is best effort",
                "  lost: 3 datagrams, dropped: socket buffer full",
                "  lost: 1 datagram, dropped: too large fragments, or fragments of unknown participants",
                "  no filter here",
                "  2 participants, socket buffer 1.0 of 8.0 MiB requested, real-time priority",
                "  3.0 MiB reserved for samples, 5.0 MiB resident, 1.0 s of CPU time",
            ]
        );
    }

    #[test]
    fn a_drive_has_no_network_and_no_losses_in_transit() {
        let topic = IngressTopic { topic: "/imu".to_owned(), ..IngressTopic::default() };
        let status = IngressStatus { topics: vec![topic], ..IngressStatus::default() };
        let text = ingress(&status, Paint { on: false });
        assert!(text.starts_with("ingress: 0 readers\n") && !text.contains("socket"), "{text}");
        assert!(text.contains("/imu         0        ?         0     ?             ?"), "{text}");
    }
}
