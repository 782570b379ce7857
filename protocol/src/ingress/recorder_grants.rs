//! Topics of the recorder, as its starter grants them.

use super::{PinGrant, Qos, TopicGrant};

/// Id of the topic of commands. Recorded topics have other ones.
pub const COMMANDS_ID: u32 = 0;

/// Type of the topic of commands.
const COMMANDS_TYPE: &str = "std_msgs/msg/String";
/// Longest command, in bytes of CDR: the length, 4 KiB of text, a zero, and padding of the last
/// four bytes.
const COMMAND_BYTES: u64 = 4 + (4 << 10) + 4;
/// Commands that wait for the recorder at most.
const COMMANDS_DEPTH: u32 = 16;

/// Bytes of the samples of one topic that wait for the recorder: it looks every 5 ms, and may be
/// interrupted for much longer.
const WAITING_BYTES: u64 = 64 << 20;
/// Samples of a topic that wait for the recorder.
const DEPTH: std::ops::RangeInclusive<u64> = 8..=1024;
/// As above, for a topic whose largest sample is unknown.
const USUAL_DEPTH: u32 = 64;

/// Neighbouring samples that the recorder holds at a time, while it copies them: several, if they
/// are small.
const SMALL_WINDOW: u16 = 16;
const LARGE_WINDOW: u16 = 1;
const SMALL_BYTES: u64 = 64 << 10;

/// Returns the grant of the topic of commands.
pub fn commands_grant(topic: &str) -> TopicGrant {
    let depth = COMMANDS_DEPTH;
    TopicGrant {
        id: COMMANDS_ID,
        topic: topic.to_owned(),
        type_name: Some(COMMANDS_TYPE.to_owned()),
        // Not earlier commands: they were executed already, or are outdated.
        qos: Qos::Fixed { reliable: true, transient_local: false, depth: depth as usize },
        queue: depth as usize,
        max_bytes: Some(COMMAND_BYTES),
        depth,
        holds: PinGrant { windows: 1, window: SMALL_WINDOW, singles: 0 },
        wakes: true,
        digests: false,
        shown: false,
    }
}

/// Returns the grant of a recorded topic of samples with `max_bytes` bytes at most; `None` for the
/// usual size of its type. `qos` is that of the input that is recorded: readers of another QoS have
/// a subscription of their own, which stamps each sample at another time.
pub fn recorded_grant(
    id: u32,
    topic: &str,
    type_name: Option<String>,
    max_bytes: Option<u64>,
    qos: Qos,
) -> TopicGrant {
    let fits = |bytes: u64| (WAITING_BYTES / bytes.max(1)).clamp(*DEPTH.start(), *DEPTH.end());
    let depth = max_bytes.map_or(USUAL_DEPTH, |bytes| fits(bytes) as u32);
    let is_small = max_bytes.is_some_and(|bytes| bytes <= SMALL_BYTES);
    TopicGrant {
        id,
        topic: topic.to_owned(),
        type_name,
        qos,
        queue: depth as usize,
        max_bytes,
        depth,
        holds: PinGrant {
            windows: 1,
            window: if is_small { SMALL_WINDOW } else { LARGE_WINDOW },
            singles: 0,
        },
        wakes: false,
        digests: false,
        shown: false,
    }
}
