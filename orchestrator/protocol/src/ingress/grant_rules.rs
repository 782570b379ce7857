//! Rule for the sizes in the grant of an input: how many samples a lambda finds and holds.

use gleaner_lambda::manifest::{self, Durability, InputSpec, Reliability};

use super::{HoldGrant, Qos, TopicGrant};

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
            holds: HoldGrant { windows, window: bounded(shown), singles: bounded(singles) },
            wakes,
            digests,
        }
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
