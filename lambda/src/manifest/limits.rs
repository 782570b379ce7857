//! `[limits]`: what a lambda may use, and how a vehicle tightens it.
//!
//! A limit is one entry of the table below: its meaning, the reason for its numbers, key, unit, and
//! bounds. The struct, its reader, its words and its JSON are made of the table here; the page on
//! the manifest, two columns of `docs/limits.md` and the numbers of both SDKs' fake hosts by `cargo
//! xtask bless` (`generated.rs`).

use std::fmt;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::bounds::Bounds;
use super::limit::{Limit, Unit, plain};
use super::table::TomlTable;
use super::{ByteSize, ManifestError};

/// Makes all of the table. `as` gives the key that a limit has in JSON, where it is another one
/// than in the file.
macro_rules! limits {
    ($($(#[doc = $meaning:literal])+ $key:ident $(as $json:literal)?: $unit:ty { $($bounds:tt)+ })+) => {
        /// What a lambda may use. `docs/limits.md` says what happens where it wants more.
        ///
        /// As JSON it has the file's keys; durations are `_ns`, sizes are in bytes. What is missing
        /// there has its default.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default)]
        #[non_exhaustive]
        pub struct Limits {
            $($(#[doc = $meaning])+ $(#[serde(rename = $json)])? #[serde(with = "plain")] pub $key: $unit,)+
        }

        impl Limits {
            /// Every limit at its minimum.
            pub const MIN: Limits = Limits { $($key: Bounds::<$unit> { $($bounds)+ }.min),+ };
            /// Every limit as it is where a manifest does not name it.
            pub const DEFAULT: Limits = Limits { $($key: Bounds::<$unit> { $($bounds)+ }.default),+ };
            /// Every limit at its maximum.
            pub const MAX: Limits = Limits { $($key: Bounds::<$unit> { $($bounds)+ }.max),+ };

            /// The keys, in the order of the table.
            pub(super) const KEYS: &[&str] = &[$(stringify!($key)),+];

            /// The table itself.
            pub(super) fn table() -> [Limit; Limits::KEYS.len()] {
                [$(Limit::new(stringify!($key), concat!($($meaning),+), Bounds::<$unit> { $($bounds)+ })),+]
            }

            /// The limits that `table` names; the others are those of `missing`.
            pub(super) fn read(table: &TomlTable, missing: Limits) -> Result<Limits, ManifestError> {
                let (min, max) = (Limits::MIN, Limits::MAX);
                Ok(Limits {
                    $($key: Unit::read(
                        table,
                        stringify!($key),
                        &Bounds { min: min.$key, default: missing.$key, max: max.$key },
                    )?),+
                })
            }

            fn smaller(&self, most: &Limits) -> Limits {
                Limits { $($key: self.$key.min(most.$key)),+ }
            }

            /// Each key with its value, as it would be written in the file.
            pub fn in_words(&self) -> [(&'static str, String); Limits::KEYS.len()] {
                [$((stringify!($key), self.$key.in_words())),+]
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

    /// Time after which a wake ends with a fault. Live only: in a replay, decisions would depend on
    /// the machine.
    deadline as "deadline_ns": Duration {
        min: Duration::from_millis(1), default: Duration::from_millis(50), max: Duration::from_secs(60)
    }

    /// Time after which `init` ends with a fault. Live only.
    // Importing numpy and loading a model take seconds; nobody waits for five minutes.
    init_deadline as "init_deadline_ns": Duration {
        min: Duration::from_millis(1), default: Duration::from_secs(10), max: Duration::from_secs(300)
    }

    /// Memory that the lambda may allocate, and as much again for pixels of frames that it makes.
    // The rings are beside it.
    memory: ByteSize { min: ByteSize::mib(1), default: ByteSize::mib(64), max: ByteSize::gib(1) }

    /// Elements of all tables of a component.
    // A lambda built from Rust has some hundred, for its function pointers. The host keeps 8 bytes
    // for each, beside `memory`: 8 MB at most.
    tables: u64 { min: 1, default: 20_000, max: 1_000_000 }

    /// Stack of a component.
    // The thread that runs it has 8 MiB, of which the host needs some for its own calls below the
    // guest's; half a mebibyte is a recursion some thousand deep.
    stack: ByteSize { min: ByteSize::kib(16), default: ByteSize::kib(512), max: ByteSize::kib(512) }

    /// Handles of all kinds that a component holds at a time.
    // Samples, frames, fields, topics and what WASI hands out. The host keeps some 200 bytes for
    // each: 13 MB at most.
    handles: u64 { min: 16, default: 4096, max: 65_536 }

    /// Frames of all inputs that the lambda holds at a time.
    // However they were made. Their pixels are bounded by `hold`, `decoded_size` and `memory`.
    frames: u64 { min: 1, default: 256, max: 4096 }

    /// Bytes that one call takes or returns.
    // A call is the shortest thing that a deadline can end, and a mebibyte takes 0.1 ms. The SDK
    // reads frames in pieces of 64 KiB.
    call_bytes: ByteSize { min: ByteSize::kib(64), default: ByteSize::mib(1), max: ByteSize::mib(1) }

    /// Samples, values or texts that one call returns.
    // As many as the deepest ring has.
    call_items: u64 { min: 16, default: 65_536, max: 65_536 }

    /// Bytes that the host keeps for the lambda by name.
    // It is memory, so nobody has some who does not ask for it.
    scratch: ByteSize { min: ByteSize::kib(0), default: ByteSize::kib(0), max: ByteSize::mib(256) }

    /// Log lines per second of the lambda's time.
    // Nobody reads more, and a disk should last.
    log_lines: u64 { min: 1, default: 100, max: 10_000 }

    /// Bytes of log lines per second of the lambda's time.
    // The default is a hundred of the longest lines.
    log_bytes: ByteSize { min: ByteSize::kib(4), default: ByteSize::kib(400), max: ByteSize::mib(16) }

    /// Triggers per minute of the lambda's time.
    // Of all kinds. The default is 200 a second, which is what a recorder takes for long from one
    // lambda; the maximum one for each wake of the shortest period.
    events_per_minute: u64 { min: 1, default: 12_000, max: 60_000 }
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
    /// The smaller one of each pair, and where that is smaller than before.
    pub fn tightened_by(&self, most: &Limits) -> (Limits, Vec<Tightened>) {
        let tight = self.smaller(most);
        let pairs = self.in_words().into_iter().zip(tight.in_words());
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
    fn a_vehicle_makes_limits_smaller_and_never_larger() {
        let mut vehicle = Limits::MAX;
        (vehicle.fuel, vehicle.deadline) = (10_000_000, Duration::from_millis(20));
        vehicle.memory = ByteSize::gib(1);
        let (limits, tightened) = Limits::default().tightened_by(&vehicle);
        let expected =
            Limits { fuel: 10_000_000, deadline: Duration::from_millis(20), ..Limits::default() };
        assert_eq!(limits, expected);
        let said: Vec<_> = tightened.iter().map(Tightened::to_string).collect();
        assert_eq!(said, ["fuel 50000000 -> 10000000", "deadline 50ms -> 20ms"]);
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
    fn what_is_missing_in_json_has_its_default_and_what_is_there_reads_back() {
        let limits: Limits =
            serde_json::from_str(r#"{"fuel":5000,"of a newer version":1}"#).unwrap();
        assert_eq!(limits, Limits { fuel: 5000, ..Limits::default() });
        let again: Limits =
            serde_json::from_value(serde_json::to_value(Limits::MAX).unwrap()).unwrap();
        assert_eq!(again, Limits::MAX);
    }
}
