//! Rule for the sizes in the grant of an input: how many samples a lambda finds and holds.

use gleaner_lambda::manifest::{self, Durability, InputSpec, Reliability};

use super::{PinGrant, PublishGrant, Qos, TopicGrant};

/// Samples up to this size are small. Memory for twice as many as a lambda reads costs little.
const SMALL_BYTES: u64 = 64 << 10;
/// Spare large samples: as many may arrive during a wake before one that it sees leaves.
const SPARE_LARGE: usize = 2;

/// Windows of small samples that a lambda holds at a time: one each for arrays, columns, a search
/// and another thread.
const WINDOWS_SMALL: u16 = 4;
/// Windows of large samples. Each held sample takes memory of its own.
const WINDOWS_LARGE: u16 = 2;
/// Single samples that a lambda holds beyond its own `hold`: the one that woke it, the newest one
/// that a wake sees, and those that two threads look up.
const SINGLES: usize = 4;

/// Type of the answers to wakes.
const ROUND_TRIP_TYPE: &str = "sensor_msgs/msg/TimeReference";
/// Answers of four seconds at 1 kHz that a reader has not acknowledged; later ones are dropped.
const ROUND_TRIP_DEPTH: usize = 4096;
/// Bytes of an answer, with 16 labels of 128 bytes, and more.
const ROUND_TRIP_BYTES: usize = 4 << 10;
/// Type of published decisions.
const DECISIONS_TYPE: &str = "std_msgs/msg/String";
/// Decisions that wait for slow readers.
const DECISIONS_DEPTH: usize = 256;
/// Bytes of a decision. Most have some hundred; 16 triggers with the longest attributes have more
/// than a message may have.
const DECISIONS_BYTES: usize = 64 << 10;

impl PublishGrant {
    /// The grants of a lambda's process: the topic on which it answers each wake, then the topic on
    /// which it publishes decisions, if there are any.
    pub fn of_lambda(round_trip: Option<&str>, decisions: Option<&str>) -> Vec<PublishGrant> {
        let round_trip = round_trip.map(|topic| PublishGrant {
            topic: topic.to_owned(),
            type_name: ROUND_TRIP_TYPE.to_owned(),
            depth: ROUND_TRIP_DEPTH,
            max_bytes: ROUND_TRIP_BYTES,
        });
        let decisions = decisions.map(|topic| PublishGrant {
            topic: topic.to_owned(),
            type_name: DECISIONS_TYPE.to_owned(),
            depth: DECISIONS_DEPTH,
            max_bytes: DECISIONS_BYTES,
        });
        round_trip.into_iter().chain(decisions).collect()
    }
}

impl TopicGrant {
    /// The grant of an input to a lambda's process. `index` is that of the input in its manifest.
    ///
    /// A lambda reads the `depth` newest samples of its wake. Spare samples keep these in place
    /// until the wake is over.
    pub fn for_input(
        index: u32,
        input: &InputSpec,
        topic_on_network: &str,
        wakes: bool,
        digests: bool,
    ) -> TopicGrant {
        let is_small = input.max_size.bytes() <= SMALL_BYTES;
        let spare = if is_small { input.depth } else { input.depth.min(SPARE_LARGE) };
        let shown = input.depth.saturating_add(spare);
        let windows = if is_small { WINDOWS_SMALL } else { WINDOWS_LARGE };
        let singles = input.hold.saturating_add(SINGLES);
        TopicGrant {
            id: index,
            topic: topic_on_network.to_owned(),
            type_name: Some(input.type_name.to_string()),
            qos: requested(input.qos),
            queue: input.depth,
            max_bytes: Some(input.max_size.bytes()),
            depth: u32::try_from(shown).unwrap_or(u32::MAX),
            holds: PinGrant { windows, window: bounded(shown), singles: bounded(singles) },
            wakes,
            digests,
            shown: false,
        }
    }

    /// Returns the grant with which a reader attaches the topic again after a restart of the
    /// ingress. All readers begin with the same sample: the first one after the restart, if they
    /// can still find it. If the run `is_recorded`, it has a digest, which readers that attach
    /// later may need.
    #[must_use]
    pub fn again(self, is_recorded: bool) -> TopicGrant {
        TopicGrant { shown: true, digests: self.digests || is_recorded, ..self }
    }
}

/// Converts the QoS of an input.
fn requested(qos: manifest::Qos) -> Qos {
    match qos {
        manifest::Qos::Auto => Qos::Auto,
        manifest::Qos::Fixed { reliability, durability, depth } => Qos::Fixed {
            reliable: reliability == Reliability::Reliable,
            transient_local: durability == Durability::TransientLocal,
            depth,
        },
    }
}

fn bounded(count: usize) -> u16 {
    u16::try_from(count).unwrap_or(u16::MAX)
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::manifest::Manifest;

    use super::*;

    /// Grants of a small input, of a large one, and of the largest that a manifest can have.
    fn grants() -> Vec<TopicGrant> {
        let text = r#"
            [lambda]
            name = "brake"
            version = "0.1.0"
            kind = "python"
            entry = "main.py"
            [schedule]
            event = "imu"
            [[input]]
            name = "imu"
            topic = "/imu"
            type = "sensor_msgs/msg/Imu"
            depth = 100
            hold = 8
            qos = { reliability = "reliable", durability = "volatile", depth = 7 }
            [[input]]
            name = "camera"
            topic = "/camera"
            type = "sensor_msgs/msg/Image"
            depth = 5
            hold = 2
            max_size = "4 MiB"
            [[input]]
            name = "longest"
            topic = "/longest"
            type = "sensor_msgs/msg/Imu"
            depth = 65536
            hold = 1024
            max_size = "1 KiB"
        "#;
        let manifest = Manifest::parse(text, "lambda.toml").unwrap();
        (0..)
            .zip(&manifest.inputs)
            .map(|(n, input)| TopicGrant::for_input(n, input, "/remapped", n == 0, true))
            .collect()
    }

    #[test]
    fn an_input_is_granted_its_depth_and_spare_samples() {
        let [small, large, longest] = <[TopicGrant; 3]>::try_from(grants()).unwrap();
        assert_eq!((small.depth, small.queue, small.max_bytes), (200, 100, Some(4096)));
        assert_eq!(small.holds, PinGrant { windows: 4, window: 200, singles: 12 });
        assert_eq!(small.qos, Qos::Fixed { reliable: true, transient_local: false, depth: 7 });
        assert_eq!((small.topic.as_str(), small.wakes, small.digests), ("/remapped", true, true));
        // Each held sample takes memory of its own: few are spare, and few are held.
        assert_eq!((large.depth, large.wakes, large.qos), (7, false, Qos::Auto));
        assert_eq!(large.holds, PinGrant { windows: 2, window: 7, singles: 6 });
        assert_eq!((longest.depth, longest.holds.window), (131_072, u16::MAX));
        for grant in [small, large, longest] {
            assert_eq!(grant.check(), Ok(()), "every manifest gives a valid grant");
        }
    }

    #[test]
    fn the_topics_that_a_lambda_publishes_take_little_memory() {
        let grants = PublishGrant::of_lambda(Some("/round_trip"), Some("/decisions"));
        for grant in &grants {
            assert_eq!(grant.check(), Ok(()));
            assert!(grant.depth * grant.max_bytes <= 16 << 20, "{grant:?}");
        }
        assert_eq!(grants.len(), 2);
    }
}
