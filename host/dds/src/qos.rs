//! Quality of service: the offers of writers, and the request of a subscription.

use std::fmt::{self, Write as _};

use rustdds::policy::{
    self, DataRepresentation, Deadline, Durability, History, Liveliness, Reliability,
    ResourceLimits,
};
use rustdds::qos::QosPolicyId;
use rustdds::{Duration, QosPolicies, QosPolicyBuilder};

use super::Distro;
use gleaner_messages::transport::Guid;

/// Most writers whose offers are recorded.
const NOTED: usize = 64;

/// The policies that a subscription requests.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    pub(super) reliable: bool,
    pub(super) transient_local: bool,
}

/// A writer, as it was announced.
#[derive(Clone, Debug)]
pub(super) struct Offer {
    pub(super) guid: Guid,
    /// The DDS name.
    pub(super) topic: String,
    /// The DDS name.
    pub(super) type_name: String,
    pub(super) qos: QosPolicies,
    pub(super) type_hash: Option<String>,
}

impl Offer {
    pub(super) fn encoding(&self) -> &'static str {
        match DataRepresentation::offered_representation(self.qos.data_representation().as_ref()) {
            policy::XCDR_DATA_REPRESENTATION => "XCDR1",
            policy::XML_DATA_REPRESENTATION => "XML",
            policy::XCDR2_DATA_REPRESENTATION => "XCDR2",
            _ => "an unknown encoding",
        }
    }

    /// Compares the offer with a request that it does not satisfy, by the policy that differs.
    pub(super) fn shortfall(&self, request: Request) -> Option<String> {
        let policy = self.qos.compliance_failure_wrt(&request.policies(1))?;
        Some(match policy {
            QosPolicyId::Reliability => "best effort, but reliable is requested".to_owned(),
            QosPolicyId::Durability => "volatile, but transient local is requested".to_owned(),
            _ => format!("{policy:?} that is incompatible with the default, which is requested"),
        })
    }
}

impl Request {
    /// The strongest request that all of `offers` satisfy, as in `ros2 bag record`: one writer that
    /// is not reliable, or that keeps nothing for late readers, decides for all.
    pub(super) fn of_all<'a>(offers: impl IntoIterator<Item = &'a Offer>) -> Self {
        offers.into_iter().fold(Self { reliable: true, transient_local: true }, |all, offer| Self {
            reliable: all.reliable && reliable(&offer.qos),
            transient_local: all.transient_local && transient_local(&offer.qos),
        })
    }

    /// Returns whether `other` requests at least as much.
    pub(super) fn within(self, other: Self) -> bool {
        self.reliable <= other.reliable && self.transient_local <= other.transient_local
    }

    /// The policies of a reader that keeps its `depth` newest samples.
    pub(super) fn policies(self, depth: usize) -> QosPolicies {
        let depth = i32::try_from(depth).unwrap_or(i32::MAX);
        let durability =
            if self.transient_local { Durability::TransientLocal } else { Durability::Volatile };
        let limits = ResourceLimits {
            max_samples: depth,
            max_instances: 1,
            max_samples_per_instance: depth,
        };
        let reliability = if self.reliable {
            Reliability::Reliable { max_blocking_time: Duration::from_millis(100) }
        } else {
            Reliability::BestEffort
        };
        QosPolicyBuilder::new()
            .reliability(reliability)
            .durability(durability)
            .history(History::KeepLast { depth })
            .resource_limits(limits)
            .build()
    }
}

impl fmt::Display for Request {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.reliable { "reliable" } else { "best effort" })?;
        f.write_str(if self.transient_local { ", transient local" } else { ", volatile" })
    }
}

/// A policy that is not announced has its default, which for a writer's reliability is the stronger
/// one.
fn reliable(qos: &QosPolicies) -> bool {
    !matches!(qos.reliability(), Some(Reliability::BestEffort))
}

fn transient_local(qos: &QosPolicies) -> bool {
    qos.durability().is_some_and(|durability| durability >= Durability::TransientLocal)
}

pub(super) fn describe(qos: &QosPolicies) -> String {
    let mut words =
        Request { reliable: reliable(qos), transient_local: transient_local(qos) }.to_string();
    if let Some(Deadline(period)) =
        qos.deadline().filter(|deadline| deadline.0 < Duration::INFINITE)
    {
        let _ = write!(words, ", deadline {} ms", period.to_nanoseconds() / 1_000_000);
    }
    if let Some(lifespan) = qos.lifespan().filter(|lifespan| lifespan.duration < Duration::INFINITE)
    {
        let _ = write!(words, ", lifespan {} ms", lifespan.duration.to_nanoseconds() / 1_000_000);
    }
    words
}

/// The offers in the format of rosbag2: with numbers up to Iron, with names after it. The depth of
/// a writer's history, which DDS does not announce, is given as unknown.
pub(super) fn as_rosbag2(offers: &[&Offer], distro: Option<Distro>) -> Option<String> {
    let numbers = distro == Some(Distro::Humble);
    let mut yaml = String::new();
    for Offer { qos, .. } in offers.iter().take(NOTED) {
        let (reliability, durability) = match (reliable(qos), transient_local(qos)) {
            (reliable, local) if numbers => {
                (if reliable { "1" } else { "2" }, if local { "1" } else { "2" })
            }
            (reliable, local) => (
                if reliable { "reliable" } else { "best_effort" },
                if local { "transient_local" } else { "volatile" },
            ),
        };
        let manual = !matches!(qos.liveliness(), None | Some(Liveliness::Automatic { .. }));
        let liveliness = match (manual, numbers) {
            (false, true) => "1",
            (false, false) => "automatic",
            (true, true) => "3",
            (true, false) => "manual_by_topic",
        };
        let history = if numbers { "3" } else { "unknown" };
        let lease = qos.liveliness().map(|liveliness| liveliness.duration());
        let _ = write!(
            yaml,
            "- history: {history}\n  depth: 0\n  reliability: {reliability}\n  \
             durability: {durability}\n  deadline:\n{}  \
             lifespan:\n{}  liveliness: {liveliness}\n  liveliness_lease_duration:\n{}  \
             avoid_ros_namespace_conventions: false\n",
            period(qos.deadline().map(|deadline| deadline.0)),
            period(qos.lifespan().map(|lifespan| lifespan.duration)),
            period(lease),
        );
    }
    (!yaml.is_empty()).then(|| yaml.trim_end().to_owned())
}

/// ROS 2 writes an infinite period as the longest time that 64 bits of nanoseconds hold, split in
/// seconds and the rest.
fn period(period: Option<Duration>) -> String {
    let endless = i64::MAX;
    let ns = period
        .filter(|period| *period < Duration::INFINITE)
        .map_or(endless, |period| period.to_nanoseconds());
    format!("    sec: {}\n    nsec: {}\n", ns / 1_000_000_000, ns % 1_000_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(reliable: bool, transient_local: bool) -> Offer {
        let qos = Request { reliable, transient_local }.policies(1);
        let (topic, type_name) = (String::new(), String::new());
        Offer { guid: Guid::default(), topic, type_name, qos, type_hash: None }
    }

    #[test]
    fn the_weakest_of_each_policy_decides() {
        for (offers, words) in [
            (vec![offer(true, true)], "reliable, transient local"),
            (vec![offer(true, true), offer(true, false)], "reliable, volatile"),
            (vec![offer(true, false), offer(false, true)], "best effort, volatile"),
            (vec![offer(false, true)], "best effort, transient local"),
        ] {
            let request = Request::of_all(&offers);
            assert_eq!(request.to_string(), words);
            for offer in &offers {
                assert_eq!(offer.qos.compliance_failure_wrt(&request.policies(4)), None);
            }
        }
    }

    #[test]
    fn a_writer_that_announces_nothing_has_the_defaults_of_dds() {
        let silent = Offer { qos: QosPolicies::default(), ..offer(false, false) };
        assert_eq!(Request::of_all([&silent]), Request { reliable: true, transient_local: false });
        assert_eq!(describe(&silent.qos), "reliable, volatile");
    }

    #[test]
    fn a_request_is_within_another_if_it_asks_for_no_more() {
        let request = |reliable, transient_local| Request { reliable, transient_local };
        assert!(request(false, false).within(request(true, false)));
        assert!(request(true, false).within(request(true, false)));
        assert!(!request(false, true).within(request(true, false)));
    }

    #[test]
    fn offers_are_noted_as_each_distribution_spells_them() {
        let (mine, other) = (offer(true, false), offer(false, true));
        let names = as_rosbag2(&[&mine, &other], None).unwrap();
        assert_eq!(names.matches("- history: unknown\n  depth: 0\n").count(), 2);
        assert!(names.contains(
            "  reliability: reliable\n  durability: volatile\n  deadline:\n    sec: 9223372036\n"
        ));
        assert!(names.contains("  reliability: best_effort\n  durability: transient_local\n"));
        let numbers = as_rosbag2(&[&mine], Some(Distro::Humble)).unwrap();
        let expected = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n";
        assert!(numbers.starts_with(expected), "{numbers}");
        assert_eq!(as_rosbag2(&[], None), None);
        let many = vec![&mine; 10_000];
        assert!(as_rosbag2(&many, None).unwrap().len() < 65_536);
    }
}
