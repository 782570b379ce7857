//! The table of `[limits]`: the resources that a lambda may use, and their reduction by a vehicle.
//!
//! A limit is one entry of the table below: its meaning, the reason for its numbers, key, unit, and
//! bounds. The macro generates the struct, its parser, its text and its JSON; `cargo xtask bless`
//! (`generated.rs`) generates `docs/manifest.md`, two columns of `docs/limits.md`, and the numbers
//! of both SDKs' fake hosts.

use std::fmt;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::bounds::Bounds;
use super::limit::{Limit, Unit, plain};
use super::table::TomlTable;
use super::{ByteSize, ManifestError};

/// Generates the code of the table. `as` gives the JSON key of a limit, if it differs from the
/// file's.
macro_rules! limits {
    ($(
        $(#[doc = $meaning:literal])+
        $key:ident $(as $json:literal)?: $unit:ty { $($bounds:tt)+ }
    )+) => {
        /// The resources that a lambda may use. `docs/limits.md` describes what happens beyond
        /// them.
        ///
        /// As JSON it has the file's keys; durations are `_ns`, sizes are in bytes. Missing keys
        /// have their default.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default)]
        #[non_exhaustive]
        pub struct Limits {
            $(
                $(#[doc = $meaning])+
                $(#[serde(rename = $json)])?
                #[serde(with = "plain")]
                pub $key: $unit,
            )+
        }

        impl Limits {
            pub const MIN: Limits = Limits { $($key: Bounds::<$unit> { $($bounds)+ }.min),+ };
            pub const DEFAULT: Limits =
                Limits { $($key: Bounds::<$unit> { $($bounds)+ }.default),+ };
            pub const MAX: Limits = Limits { $($key: Bounds::<$unit> { $($bounds)+ }.max),+ };

            /// The keys, in the order of the table.
            pub(super) const KEYS: &[&str] = &[$(stringify!($key)),+];

            pub(super) fn table() -> [Limit; Limits::KEYS.len()] {
                [$(Limit::new(
                    stringify!($key),
                    concat!($($meaning),+),
                    Bounds::<$unit> { $($bounds)+ },
                )),+]
            }

            /// Parses the limits in `table`; the others are those of `missing`.
            pub(super) fn read(
                table: &TomlTable,
                missing: Limits,
            ) -> Result<Limits, ManifestError> {
                let (min, max) = (Limits::MIN, Limits::MAX);
                Ok(Limits {
                    $($key: Unit::read(
                        table,
                        stringify!($key),
                        &Bounds { min: min.$key, default: missing.$key, max: max.$key },
                    )?),+
                })
            }

            fn smaller(&self, max: &Limits) -> Limits {
                Limits { $($key: self.$key.min(max.$key)),+ }
            }

            /// Returns each key with its value, as written in the file.
            pub fn describe(&self) -> [(&'static str, String); Limits::KEYS.len()] {
                [$((stringify!($key), self.$key.describe())),+]
            }
        }
    };
}

limits! {
    /// Fuel units per wake; components only.
    // About one unit per WebAssembly instruction, so that the default is some 20 ms.
    fuel: u64 { min: 1_000, default: 50_000_000, max: 1_000_000_000_000 }

    /// Fuel units for `init`; components only.
    // `init` builds its tables once, and may take as much as twenty wakes by default.
    init_fuel: u64 { min: 1_000, default: 1_000_000_000, max: 1_000_000_000_000 }

    /// CPU time after which a wake ends with a fault; by the clock, five times as much. Live only:
    /// in a replay, decisions would depend on the machine.
    deadline as "deadline_ns": Duration {
        min: Duration::from_millis(1),
        default: Duration::from_millis(50),
        max: Duration::from_secs(60)
    }

    /// The same for `init`. Live only.
    // Importing numpy and loading a model take seconds; five minutes are enough for any start.
    init_deadline as "init_deadline_ns": Duration {
        min: Duration::from_millis(1),
        default: Duration::from_secs(10),
        max: Duration::from_secs(300)
    }

    /// Time that the models of a wake may run. Live only.
    // A model runs in another process, so this bounds what a lambda takes from the others; the
    // deadline of the wake holds as well.
    model_time as "model_time_ns": Duration {
        min: Duration::from_millis(1),
        default: Duration::from_secs(1),
        max: Duration::from_secs(60)
    }

    /// Memory that the lambda may allocate, and as much again for frames and tensors that it makes.
    // The memory of the rings comes on top.
    memory: ByteSize { min: ByteSize::mib(1), default: ByteSize::mib(64), max: ByteSize::gib(1) }

    /// Elements of all tables of a component.
    // A Rust lambda has some hundred, for its function pointers. The host keeps 8 bytes for each,
    // on top of `memory`: 8 MB at most.
    tables: u64 { min: 1, default: 20_000, max: 1_000_000 }

    /// Stack of a component.
    // The thread that runs it has 8 MiB, which host calls use, too; half a mebibyte allows a
    // recursion some thousand deep.
    stack: ByteSize { min: ByteSize::kib(16), default: ByteSize::kib(512), max: ByteSize::kib(512) }

    /// Handles of all kinds that a component holds at a time.
    // Samples, frames, fields, topics and WASI resources. The host keeps some 200 bytes for each:
    // 13 MB at most.
    handles: u64 { min: 16, default: 4096, max: 65_536 }

    /// Frames of all inputs, and tensors, that the lambda holds at a time.
    // Of any origin. Their pixels are limited by `hold`, `decoded_size` and `memory`.
    frames: u64 { min: 1, default: 256, max: 4096 }

    /// Bytes that one call takes or returns.
    // A deadline cannot end a call half-way, and copying a mebibyte takes 0.1 ms. The SDK reads
    // frames in pieces of 64 KiB.
    call_bytes: ByteSize {
        min: ByteSize::kib(64), default: ByteSize::mib(1), max: ByteSize::mib(1)
    }

    /// Samples, values or texts that one call returns.
    // The size of the deepest ring.
    call_items: u64 { min: 16, default: 65_536, max: 65_536 }

    /// Bytes that the host keeps for the lambda by name.
    // It takes memory, so it has to be requested.
    scratch: ByteSize { min: ByteSize::kib(0), default: ByteSize::kib(0), max: ByteSize::mib(256) }

    /// Log lines per second of the lambda's time.
    // More would fill the disk, and would not be read.
    log_lines: u64 { min: 1, default: 100, max: 10_000 }

    /// Bytes of log lines per second of the lambda's time.
    // The default is a hundred of the longest lines.
    log_bytes: ByteSize {
        min: ByteSize::kib(4), default: ByteSize::kib(400), max: ByteSize::mib(16)
    }

    /// Triggers per minute of the lambda's time.
    // Of all kinds. The default is 200 a second, the sustained rate that a recorder accepts from
    // one lambda; the maximum is one for each wake of the shortest period.
    events_per_minute: u64 { min: 1, default: 12_000, max: 60_000 }
}

/// A limit that a vehicle reduced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tightened {
    pub key: &'static str,
    /// The value in the manifest.
    pub from: String,
    /// The effective value.
    pub to: String,
}

impl fmt::Display for Tightened {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} -> {}", self.key, self.from, self.to)
    }
}

impl Limits {
    /// Returns the smaller value of each pair, and the limits that `max` reduced.
    pub fn tightened_by(&self, max: &Limits) -> (Limits, Vec<Tightened>) {
        let tight = self.smaller(max);
        let pairs = self.describe().into_iter().zip(tight.describe());
        let tightened = pairs.filter(|(before, after)| before != after);
        (tight, tightened.map(|((key, from), (_, to))| Tightened { key, from, to }).collect())
    }
}

impl Default for Limits {
    fn default() -> Limits {
        Limits::DEFAULT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vehicle_reduces_limits_and_never_raises_them() {
        let mut vehicle = Limits::MAX;
        (vehicle.fuel, vehicle.deadline) = (10_000_000, Duration::from_millis(20));
        vehicle.memory = ByteSize::gib(1);
        let (limits, tightened) = Limits::default().tightened_by(&vehicle);
        let expected =
            Limits { fuel: 10_000_000, deadline: Duration::from_millis(20), ..Limits::default() };
        assert_eq!(limits, expected);
        let texts: Vec<_> = tightened.iter().map(Tightened::to_string).collect();
        assert_eq!(texts, ["fuel 50000000 -> 10000000", "deadline 50ms -> 20ms"]);
        assert_eq!(limits.tightened_by(&Limits::MAX), (limits, Vec::new()));
    }

    #[test]
    fn every_limit_can_be_tightened_by_itself() {
        let smallest = serde_json::to_value(Limits::MIN).unwrap();
        for (key, least) in smallest.as_object().unwrap() {
            let mut vehicle = serde_json::to_value(Limits::MAX).unwrap();
            vehicle[key] = least.clone();
            let vehicle: Limits = serde_json::from_value(vehicle).unwrap();
            let (tight, tightened) = Limits::MAX.tightened_by(&vehicle);
            assert_eq!(serde_json::to_value(tight).unwrap()[key], *least, "{key}");
            assert_eq!(tightened.len(), 1, "{key}");
        }
    }

    #[test]
    fn missing_limits_in_json_have_their_default_and_others_are_parsed_back() {
        let limits: Limits =
            serde_json::from_str(r#"{"fuel":5000,"of a newer version":1}"#).unwrap();
        assert_eq!(limits, Limits { fuel: 5000, ..Limits::default() });
        let again: Limits =
            serde_json::from_value(serde_json::to_value(Limits::MAX).unwrap()).unwrap();
        assert_eq!(again, Limits::MAX);
    }
}
