//! The default, minimum and maximum of every number in a manifest, with reasons. Those of
//! `[limits]` are in its table, `limits.rs`.

use std::ops::RangeInclusive;
use std::time::Duration;

use super::ByteSize;

/// The range and the default of a number in a manifest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds<T> {
    pub min: T,
    /// The value of a manifest that does not name the key.
    pub default: T,
    pub max: T,
}

impl<T: Copy> Bounds<T> {
    pub fn range(&self) -> RangeInclusive<T> {
        self.min..=self.max
    }
}

/// `input.depth` of small samples: the number of samples in the ring. The default is over half a
/// second of a typical IMU; the maximum is over a minute at 1 kHz.
pub const DEPTH_SMALL: Bounds<u64> = Bounds { min: 1, default: 64, max: 65_536 };

/// `input.depth` of large samples: frames and point clouds.
pub const DEPTH_LARGE: Bounds<u64> = Bounds { default: 4, ..DEPTH_SMALL };

/// `input.hold`: the number of samples that a lambda may hold beyond the ring, at least the one
/// that woke it.
pub const HOLD_SMALL: Bounds<u64> = Bounds { min: 1, default: 8, max: 1024 };

/// `input.hold` of large samples.
pub const HOLD_LARGE: Bounds<u64> = Bounds { default: 2, ..HOLD_SMALL };

/// `input.max_size` of small samples, as CDR.
pub const MAX_SIZE_SMALL: Bounds<ByteSize> =
    Bounds { min: ByteSize::new(1), default: ByteSize::kib(4), max: ByteSize::mib(256) };

/// `input.max_size` of large samples: a raw 1080p frame takes 6 MiB.
pub const MAX_SIZE_LARGE: Bounds<ByteSize> = Bounds { default: ByteSize::mib(8), ..MAX_SIZE_SMALL };

/// `input.decoded_size`: the largest compressed image, once decoded to rgb8. 1080p takes 6 MiB.
pub const DECODED_SIZE: Bounds<ByteSize> = MAX_SIZE_LARGE;

/// Maximum memory of all inputs of one lambda. It is allocated before the first sample.
pub const INPUTS_MEMORY_MAX: ByteSize = ByteSize::gib(2);

/// `input.qos.depth`: the history that DDS keeps.
pub const QOS_DEPTH: Bounds<u64> = Bounds { min: 1, default: 10, max: 65_536 };

/// `schedule.period`; it has no default. A period below 1 ms is too short for one call per tick.
pub const PERIOD: RangeInclusive<Duration> = Duration::from_millis(1)..=Duration::from_secs(3600);

/// `record.preroll` and `record.postroll`.
pub const ROLL: Bounds<Duration> =
    Bounds { min: Duration::ZERO, default: Duration::from_secs(5), max: Duration::from_secs(600) };

/// `record.cooldown`: the time after a trigger in which further triggers open no new window.
pub const COOLDOWN: Bounds<Duration> =
    Bounds { min: Duration::ZERO, default: Duration::ZERO, max: Duration::from_secs(3600) };

/// `record.preroll_size` in memory. The default holds 5 s at 12 MiB/s.
pub const PREROLL_SIZE_RAM: Bounds<ByteSize> =
    Bounds { min: ByteSize::mib(1), default: ByteSize::mib(64), max: ByteSize::gib(1) };

/// `record.preroll_size` on disk. A sixteenth of it is one chunk, which should be worth a file.
pub const PREROLL_SIZE_DISK: Bounds<ByteSize> =
    Bounds { min: ByteSize::mib(16), default: ByteSize::gib(1), max: ByteSize::gib(256) };

/// `record.max_length`: a longer recording continues in the next clip, so that a `start` without
/// `stop` leaves files that can be moved and opened.
pub const MAX_LENGTH: Bounds<Duration> = Bounds {
    min: Duration::from_secs(1),
    default: Duration::from_secs(600),
    max: Duration::from_secs(3600),
};

/// `demand.rate_hz`: from one wake in twenty minutes to ten times the shortest period.
pub const RATE_HZ: RangeInclusive<f64> = 0.001..=10_000.0;

/// `demand.cpu` and `demand.model_time`: from the smallest that is worth a number to the longest
/// deadline.
pub const DEMAND_TIME: RangeInclusive<Duration> =
    Duration::from_micros(1)..=Duration::from_secs(60);

/// `model.threads`. By default, a model leaves the other cores to the lambdas.
pub const THREADS: Bounds<u64> = Bounds { min: 1, default: 1, max: 64 };

/// Values of `model.layout`.
pub const LAYOUTS: &[&str] = &["ultralytics", "yolox", "nms-free", "nanodet"];

/// Values in `model.providers`.
pub const PROVIDERS: &[&str] = &["tensorrt", "cuda", "cpu", "onnxruntime", "rten"];

/// `inference.memory` of a vehicle: the memory of the process that runs the models of all lambdas.
pub const INFERENCE_MEMORY: Bounds<ByteSize> =
    Bounds { min: ByteSize::mib(256), default: ByteSize::gib(2), max: ByteSize::gib(1024) };

/// `inference.run_max` of a vehicle: the longest run of a model without a deadline.
pub const RUN_MAX: Bounds<Duration> = Bounds {
    min: Duration::from_secs(1),
    default: Duration::from_secs(30),
    max: Duration::from_secs(3600),
};

/// `inference.load_max` of a vehicle. A provider that compiles models may need minutes.
pub const LOAD_MAX: Bounds<Duration> = Bounds { default: Duration::from_secs(120), ..RUN_MAX };

/// `deployments.probation` of a vehicle: the time that a revision must run before it is trusted to
/// work.
pub const PROBATION: Bounds<Duration> = Bounds {
    min: Duration::from_secs(1),
    default: Duration::from_secs(600),
    max: Duration::from_secs(7 * 86_400),
};

/// `deployments.spool` of a vehicle: the decisions and log lines of one lambda on the disk.
pub const SPOOL: Bounds<ByteSize> =
    Bounds { min: ByteSize::mib(1), default: ByteSize::mib(64), max: ByteSize::gib(64) };

/// `deployments.cpu` of a vehicle: the share of its cores that lambdas may ask for. The rest is for
/// the ingress, which takes a tenth to a third of a core (`bench/README.md`), the recorder, and
/// other programs.
pub const CPU_SHARE: Bounds<f64> = Bounds { min: 0.01, default: 0.8, max: 1.0 };

/// `deployments.model_time` of a vehicle: the share of its time that the process of models may run
/// models. Models run one at a time, so the nearer it is to 1, the longer they wait for each other.
pub const MODEL_SHARE: Bounds<f64> = CPU_SHARE;

/// Longest accepted manifest. The longest in use has 3 KiB.
pub const MANIFEST_MAX: ByteSize = ByteSize::mib(1);

/// Maximum number of inputs, models, config items, recorded topics or `files` of one lambda.
pub const ITEMS_MAX: usize = 256;
