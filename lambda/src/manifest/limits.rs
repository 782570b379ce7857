//! `[limits]`: what a lambda may use, and how a vehicle tightens it.

use std::fmt;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::read_limits::{Missing, all};
use super::{ByteSize, format_duration};

/// What a lambda may use. `docs/limits.md` says what happens where it wants more.
///
/// As JSON it has the file's keys; durations are `_ns`, sizes are in bytes. What is missing there has its default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
#[non_exhaustive]
pub struct Limits {
    /// Fuel units for each wake; without meaning for Python.
    pub fuel: u64,
    /// Fuel units for `init`, likewise.
    pub init_fuel: u64,
    /// Time until a wake ends with a fault. Live only: in a replay it would make decisions depend on the machine.
    #[serde(rename = "deadline_ns", with = "nanoseconds")]
    pub deadline: Duration,
    /// Time until `init` does, likewise.
    #[serde(rename = "init_deadline_ns", with = "nanoseconds")]
    pub init_deadline: Duration,
    /// Memory that the lambda itself may allocate, and once more the pixels of the frames that it makes.
    pub memory: ByteSize,
    /// Elements of all tables of a component together.
    pub tables: u64,
    /// Stack of a component.
    pub stack: ByteSize,
    /// Handles that a component holds at a time, of all kinds.
    pub handles: u64,
    /// Frames that the lambda holds at a time, of all inputs.
    pub frames: u64,
    /// Bytes that one call takes or gives.
    pub call_bytes: ByteSize,
    /// Samples, values or texts that one call gives.
    pub call_items: u64,
    /// Bytes that the host keeps for the lambda, by name.
    pub scratch: ByteSize,
    /// Log lines for each second of the lambda's time.
    pub log_lines: u64,
    /// Bytes of log lines, likewise.
    pub log_bytes: ByteSize,
    /// Triggers for each minute of the lambda's time.
    pub events_per_minute: u64,
}

/// A limit that a vehicle made smaller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tightened {
    /// Its key.
    pub key: &'static str,
    /// What the manifest says.
    pub from: String,
    /// What holds.
    pub to: String,
}

impl fmt::Display for Tightened {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} -> {}", self.key, self.from, self.to)
    }
}

impl Limits {
    /// Every limit at its maximum.
    pub fn most() -> Limits {
        all(None, Missing::Most).expect("nothing is read")
    }

    /// The smaller one of each pair, and where that is smaller than before.
    pub fn tightened_by(&self, most: &Limits) -> (Limits, Vec<Tightened>) {
        let tight = Limits {
            fuel: self.fuel.min(most.fuel),
            init_fuel: self.init_fuel.min(most.init_fuel),
            deadline: self.deadline.min(most.deadline),
            init_deadline: self.init_deadline.min(most.init_deadline),
            memory: self.memory.min(most.memory),
            tables: self.tables.min(most.tables),
            stack: self.stack.min(most.stack),
            handles: self.handles.min(most.handles),
            frames: self.frames.min(most.frames),
            call_bytes: self.call_bytes.min(most.call_bytes),
            call_items: self.call_items.min(most.call_items),
            scratch: self.scratch.min(most.scratch),
            log_lines: self.log_lines.min(most.log_lines),
            log_bytes: self.log_bytes.min(most.log_bytes),
            events_per_minute: self.events_per_minute.min(most.events_per_minute),
        };
        let pairs = self.in_words().into_iter().zip(tight.in_words());
        let tightened = pairs.filter(|(before, after)| before != after);
        (tight, tightened.map(|((key, from), (_, to))| Tightened { key, from, to }).collect())
    }

    /// Each key with its value, as it would be written in the file.
    pub fn in_words(&self) -> [(&'static str, String); 15] {
        [
            ("fuel", self.fuel.to_string()),
            ("init_fuel", self.init_fuel.to_string()),
            ("deadline", format_duration(self.deadline)),
            ("init_deadline", format_duration(self.init_deadline)),
            ("memory", self.memory.to_string()),
            ("tables", self.tables.to_string()),
            ("stack", self.stack.to_string()),
            ("handles", self.handles.to_string()),
            ("frames", self.frames.to_string()),
            ("call_bytes", self.call_bytes.to_string()),
            ("call_items", self.call_items.to_string()),
            ("scratch", self.scratch.to_string()),
            ("log_lines", self.log_lines.to_string()),
            ("log_bytes", self.log_bytes.to_string()),
            ("events_per_minute", self.events_per_minute.to_string()),
        ]
    }
}

impl Default for Limits {
    fn default() -> Limits {
        all(None, Missing::Default).expect("nothing is read")
    }
}

/// Durations as JSON. None of them exceeds an hour, so that their nanoseconds fit.
mod nanoseconds {
    use std::time::Duration;

    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        u64::deserialize(deserializer).map(Duration::from_nanos)
    }
}

#[cfg(test)]
mod tests {
    use super::super::read_limits::KEYS;
    use super::*;

    #[test]
    fn every_key_of_the_file_has_its_words() {
        assert_eq!(Limits::default().in_words().map(|(key, _)| key), *KEYS);
    }

    #[test]
    fn a_vehicle_makes_limits_smaller_and_never_larger() {
        let mut vehicle = Limits::most();
        (vehicle.fuel, vehicle.deadline) = (10_000_000, Duration::from_millis(20));
        vehicle.memory = ByteSize::gib(1);
        let (limits, tightened) = Limits::default().tightened_by(&vehicle);
        let expected = Limits { fuel: 10_000_000, deadline: Duration::from_millis(20), ..Limits::default() };
        assert_eq!(limits, expected);
        let said: Vec<_> = tightened.iter().map(Tightened::to_string).collect();
        assert_eq!(said, ["fuel 50000000 -> 10000000", "deadline 50ms -> 20ms"]);
        assert_eq!(limits.tightened_by(&Limits::most()), (limits, Vec::new()));
    }

    #[test]
    fn every_limit_can_be_tightened_by_itself() {
        let smallest = serde_json::to_value(all(None, Missing::Least).unwrap()).unwrap();
        for (key, least) in smallest.as_object().unwrap() {
            let mut vehicle = serde_json::to_value(Limits::most()).unwrap();
            vehicle[key] = least.clone();
            let vehicle: Limits = serde_json::from_value(vehicle).unwrap();
            let (tight, tightened) = Limits::most().tightened_by(&vehicle);
            assert_eq!(serde_json::to_value(tight).unwrap()[key], *least, "{key}");
            assert_eq!(tightened.len(), 1, "{key}");
        }
    }

    #[test]
    fn what_is_missing_in_json_has_its_default_and_what_is_there_reads_back() {
        let limits: Limits = serde_json::from_str(r#"{"fuel":5000,"of a newer version":1}"#).unwrap();
        assert_eq!(limits, Limits { fuel: 5000, ..Limits::default() });
        let again: Limits = serde_json::from_value(serde_json::to_value(Limits::most()).unwrap()).unwrap();
        assert_eq!(again, Limits::most());
    }
}
