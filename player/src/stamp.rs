//! Writes `header.stamp` when a message is sent.

use clap::ValueEnum;
use gleaner_messages::{Definitions, Endian, header_stamp};
use rustix::time::{ClockId, clock_gettime};

use crate::cdr::ENCAPSULATION;

/// Source of the value of `header.stamp`.
#[derive(Copy, Clone, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum StampMode {
    /// The wall clock when sent
    Now,
    /// As recorded; with --loop, shifted by the duration of the earlier rounds
    Recorded,
    /// The monotonic clock when sent, to measure delays on one machine
    Monotonic,
}

/// Returns whether messages of a type have a stamp that [`write`] can set: in their first eight
/// bytes.
pub(crate) fn has_stamp(definitions: &Definitions) -> bool {
    header_stamp(definitions).is_some()
}

/// Writes the stamp into `message`, whose type [`has_stamp`]. `later_ns` is the duration of the
/// earlier rounds.
///
/// Returns false if the message is too short for a stamp.
pub(crate) fn write(message: &mut [u8], endian: Endian, stamp: StampMode, later_ns: i64) -> bool {
    let Some(field) = message.get_mut(ENCAPSULATION..ENCAPSULATION + 8) else {
        return false;
    };
    let (sec, nanosec) = match stamp {
        StampMode::Now => split(now(ClockId::Realtime)),
        StampMode::Monotonic => split(now(ClockId::Monotonic)),
        StampMode::Recorded if later_ns == 0 => return true,
        StampMode::Recorded => split(read(field, endian).saturating_add(later_ns)),
    };
    let (sec, nanosec) = match endian {
        Endian::Little => (sec.to_le_bytes(), nanosec.to_le_bytes()),
        Endian::Big => (sec.to_be_bytes(), nanosec.to_be_bytes()),
    };
    field[..4].copy_from_slice(&sec);
    field[4..].copy_from_slice(&nanosec);
    true
}

/// The time of a clock in ns.
pub(crate) fn now(clock: ClockId) -> i64 {
    let time = clock_gettime(clock);
    time.tv_sec.saturating_mul(1_000_000_000).saturating_add(time.tv_nsec)
}

/// Splits nanoseconds into seconds and nanoseconds of ROS 2, clamped to the range of its seconds.
pub(crate) fn split(ns: i64) -> (i32, u32) {
    let sec = ns.div_euclid(1_000_000_000).clamp(i64::from(i32::MIN), i64::from(i32::MAX));
    // Both fit: one was clamped, the other is below 10^9.
    (sec as i32, ns.rem_euclid(1_000_000_000) as u32)
}

fn read(field: &[u8], endian: Endian) -> i64 {
    let part = |at: usize| -> [u8; 4] { std::array::from_fn(|n| field[at + n]) };
    let (sec, nanosec) = match endian {
        Endian::Little => (i32::from_le_bytes(part(0)), u32::from_le_bytes(part(4))),
        Endian::Big => (i32::from_be_bytes(part(0)), u32::from_be_bytes(part(4))),
    };
    i64::from(sec) * 1_000_000_000 + i64::from(nanosec)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(endian: u8, stamp: [u8; 8]) -> Vec<u8> {
        [&[0, endian, 0, 0][..], &stamp, &[9; 4]].concat()
    }

    #[test]
    fn a_recorded_stamp_is_untouched_in_the_first_round() {
        // Not even one whose nanoseconds are out of range.
        let mut bytes = message(1, [0xff; 8]);
        assert!(write(&mut bytes, Endian::Little, StampMode::Recorded, 0));
        assert_eq!(bytes, message(1, [0xff; 8]));
    }

    #[test]
    fn a_recorded_stamp_is_shifted_in_later_rounds_in_both_byte_orders() {
        let mut little = message(1, [2, 0, 0, 0, 0, 0xca, 0x9a, 0x3b - 1]);
        let mut big = message(0, [0, 0, 0, 2, 0x3b - 1, 0x9a, 0xca, 0]);
        assert!(write(&mut little, Endian::Little, StampMode::Recorded, 3_000_000_000));
        assert!(write(&mut big, Endian::Big, StampMode::Recorded, 3_000_000_000));
        assert_eq!(little, message(1, [5, 0, 0, 0, 0, 0xca, 0x9a, 0x3a]));
        assert_eq!(big, message(0, [0, 0, 0, 5, 0x3a, 0x9a, 0xca, 0]));
    }

    #[test]
    fn the_clocks_at_sending_replace_the_stamp_and_nothing_else() {
        for (stamp, clock) in
            [(StampMode::Now, ClockId::Realtime), (StampMode::Monotonic, ClockId::Monotonic)]
        {
            let mut bytes = message(0, [0; 8]);
            let before = now(clock);
            assert!(write(&mut bytes, Endian::Big, stamp, 0));
            let written = read(&bytes[4..12], Endian::Big);
            assert!((before..=now(clock)).contains(&written));
            assert_eq!((&bytes[..4], &bytes[12..]), (&[0, 0, 0, 0][..], &[9; 4][..]));
        }
    }

    #[test]
    fn a_message_too_short_for_a_stamp_is_unchanged() {
        let mut bytes = vec![0, 1, 0, 0, 1, 2, 3];
        assert!(!write(&mut bytes, Endian::Little, StampMode::Now, 0));
        assert_eq!(bytes, [0, 1, 0, 0, 1, 2, 3]);
    }

    #[test]
    fn times_before_1970_and_beyond_2038_have_a_stamp() {
        assert_eq!(split(-1), (-1, 999_999_999));
        assert_eq!(split(i64::MAX), (i32::MAX, 854_775_807));
        assert_eq!(split(i64::MIN).0, i32::MIN);
    }
}
