//! The demand of a lambda: a pure function of its manifest and of what was measured.

use std::collections::BTreeMap;

use gleaner_base::{ByteSize, format_duration, grouped};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{LambdaKind, ScheduleSpec, Sha256, Store, TopicName};

use super::measured::MeasuredUse;

/// Memory of the process of a lambda beside what its limits count, as measured with the examples:
/// host and shim of a component; interpreter and numpy of a Python lambda.
const WASM_PROCESS: ByteSize = ByteSize::mib(24);
const PYTHON_PROCESS: ByteSize = ByteSize::mib(96);

/// CPU time of a wake beside that of its code. An empty lambda takes 40 us at 1 kHz, and 300 us at
/// 30 Hz, when caches are cold (`bench/README.md`).
const HOST_PER_WAKE: f64 = 0.3e-3;
/// CPU time that is assumed of a wake until it is stated or measured: three and seven times that
/// of an empty lambda.
const WASM_PER_WAKE: f64 = 1e-3;
const PYTHON_PER_WAKE: f64 = 2e-3;
/// Model time that is assumed of a wake for each model until it is stated or measured: that of a
/// small detector on a CPU.
const MODEL_PER_WAKE: f64 = 20e-3;
/// Wakes per second that are assumed of an event schedule: usual rates of cameras and lidars, and
/// of an IMU.
const LARGE_RATE: f64 = 30.0;
const SMALL_RATE: f64 = 100.0;
/// Most cores, and most model time, that an assumption asks for: an assumption alone should not
/// use up a small machine.
const ASSUMED_MAX: f64 = 0.5;
/// Use beyond the stated one that is tolerated: measurements vary, and short wakes are rounded.
const TOLERANCE: f64 = 1.1;
const TOLERANCE_CORES: f64 = 0.01;
/// Providers of models that run on an accelerator, and take no core.
const ACCELERATED: [&str; 2] = ["tensorrt", "cuda"];

/// Origin of a number, the most certain first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum DemandSource {
    /// It follows from the manifest's limits and inputs.
    Limits,
    Stated,
    /// It was measured on this vehicle.
    Measured,
    /// Neither; it is a usual value.
    Assumed,
}

impl DemandSource {
    fn as_str(self) -> &'static str {
        match self {
            Self::Limits => "of its limits",
            Self::Stated => "stated",
            Self::Measured => "measured",
            Self::Assumed => "assumed",
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Asked {
    pub(crate) amount: f64,
    source: DemandSource,
    /// Its factors, for users.
    factors: String,
    /// Amount in the busiest minute, if measured.
    pub(crate) peak: Option<f64>,
    /// True if more is used than is stated.
    pub(crate) exceeds: bool,
}

impl Asked {
    fn new(amount: f64, source: DemandSource, factors: String) -> Self {
        Self { amount, source, factors, peak: None, exceeds: false }
    }

    fn nothing() -> Self {
        Self::new(0.0, DemandSource::Limits, String::new())
    }

    /// Returns its origin, for users.
    pub(crate) fn source(&self) -> String {
        let Self { source, factors, .. } = self;
        match factors.is_empty() {
            true => source.as_str().to_owned(),
            false => format!("{}: {factors}", source.as_str()),
        }
    }

    /// Returns the larger one: of a revision and its fallback, either may run.
    fn larger(self, other: Self) -> Self {
        let exceeds = self.exceeds || other.exceeds;
        let peak = self.peak.into_iter().chain(other.peak).reduce(f64::max);
        let larger = if other.amount > self.amount { other } else { self };
        Self { peak, exceeds, ..larger }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LambdaDemand {
    /// Memory, in bytes.
    pub(crate) memory: Asked,
    /// CPU time, in cores.
    pub(crate) cpu: Asked,
    /// Time of the process of models, in s/s.
    pub(crate) model_time: Asked,
    /// Shared memory of each topic, in bytes.
    pub(crate) topics: BTreeMap<TopicName, u64>,
}

/// Measurements of the machine and of its lambdas, as a demand depends on them.
pub(crate) struct DemandModel<'a> {
    /// Fuel units per second.
    pub(crate) fuel_per_s: f64,
    /// Uses of revisions, by their digests.
    pub(crate) uses: &'a BTreeMap<Sha256, MeasuredUse>,
    /// Mean run times of models, in s, by the digests of their files.
    pub(crate) models: &'a BTreeMap<Sha256, f64>,
}

impl DemandModel<'_> {
    /// Returns the demand of a deployment: for each resource, the largest of its revisions.
    pub(crate) fn of(&self, revisions: &[(Sha256, Manifest)]) -> Option<LambdaDemand> {
        let all = revisions.iter().map(|(digest, manifest)| self.of_one(digest, manifest));
        all.reduce(|one, other| {
            let mut topics = one.topics;
            for (topic, bytes) in other.topics {
                let known = topics.entry(topic).or_default();
                *known = bytes.max(*known);
            }
            LambdaDemand {
                memory: one.memory.larger(other.memory),
                cpu: one.cpu.larger(other.cpu),
                model_time: one.model_time.larger(other.model_time),
                topics,
            }
        })
    }

    fn of_one(&self, digest: &Sha256, manifest: &Manifest) -> LambdaDemand {
        let used = self.uses.get(digest);
        let rate = rate(manifest, used);
        let model_time = self.model_time(manifest, used, &rate);
        let mut cpu = self.cpu(manifest, used, &rate);
        let is_on_cpu = |providers: &[String]| {
            !providers.iter().any(|provider| ACCELERATED.contains(&provider.as_str()))
        };
        let on_cpu = manifest.models.iter().filter(|model| is_on_cpu(&model.providers));
        let threads = on_cpu.map(|model| model.threads).max().unwrap_or(0);
        if threads > 0 && model_time.amount > 0.0 {
            cpu.amount += model_time.amount * threads as f64;
            cpu.source = cpu.source.max(model_time.source);
            cpu.factors += &format!("; models {:.2} s/s on {threads}", model_time.amount);
            cpu.factors += if threads == 1 { " thread" } else { " threads" };
        }
        let topics = manifest.inputs.iter().map(|input| {
            let bytes = (input.slots() as u64).saturating_mul(input.max_size.bytes());
            (input.topic.clone(), bytes)
        });
        LambdaDemand { memory: memory(manifest), cpu, model_time, topics: topics.collect() }
    }

    fn cpu(&self, manifest: &Manifest, used: Option<&MeasuredUse>, rate: &WakeRate) -> Asked {
        let per_wake = match (manifest.demand.cpu, manifest.demand.fuel) {
            (Some(cpu), _) => Some((cpu.as_secs_f64(), format_duration(cpu))),
            (None, Some(fuel)) => {
                let speed = self.fuel_per_s;
                let millions = grouped((speed / 1e6).round());
                let text = format!("{} fuel units at {millions} M/s", grouped(fuel));
                Some((HOST_PER_WAKE + fuel as f64 / speed, text))
            }
            (None, None) => None,
        };
        let stated = per_wake.map(|(per_wake, text)| rate.times(per_wake, &text));
        let assumed = || {
            let per_wake = match manifest.lambda.kind {
                LambdaKind::Wasm => WASM_PER_WAKE,
                LambdaKind::Python => PYTHON_PER_WAKE,
            };
            rate.assumed(per_wake.min(manifest.limits.deadline.as_secs_f64()))
        };
        choose(stated, used.map(|used| used.cpu), assumed)
    }

    fn model_time(
        &self,
        manifest: &Manifest,
        used: Option<&MeasuredUse>,
        rate: &WakeRate,
    ) -> Asked {
        if manifest.models.is_empty() {
            return Asked::nothing();
        }
        let stated = manifest.demand.model_time;
        let stated = stated.map(|time| rate.times(time.as_secs_f64(), &format_duration(time)));
        let assumed = || {
            let times = manifest.models.iter().map(|model| self.models.get(&model.sha256));
            let sum: f64 = times.clone().map(|time| time.unwrap_or(&MODEL_PER_WAKE)).sum();
            let most = manifest.limits.model_time.as_secs_f64();
            let mut asked = rate.assumed(sum.min(most));
            if times.into_iter().all(|time| time.is_some()) {
                // Of a model that another lambda runs.
                asked.source = rate.source.max(DemandSource::Measured);
            }
            asked
        };
        choose(stated, used.map(|used| used.model_time), assumed)
    }
}

struct WakeRate {
    hz: f64,
    source: DemandSource,
}

impl WakeRate {
    fn times(&self, per_wake: f64, text: &str) -> Asked {
        let factors = format!("{} wakes/s of {text}", rounded(self.hz));
        Asked::new(self.hz * per_wake, self.source.max(DemandSource::Stated), factors)
    }

    fn assumed(&self, per_wake: f64) -> Asked {
        let factors = format!("{} wakes/s of {} ms", rounded(self.hz), rounded(per_wake * 1e3));
        let amount = (self.hz * per_wake).min(ASSUMED_MAX);
        Asked::new(amount, DemandSource::Assumed, factors)
    }
}

fn rate(manifest: &Manifest, used: Option<&MeasuredUse>) -> WakeRate {
    let (hz, source) = match (&manifest.schedule, manifest.demand.rate_hz, used) {
        (ScheduleSpec::Periodic { period }, _, _) => {
            (1.0 / period.as_secs_f64(), DemandSource::Stated)
        }
        (ScheduleSpec::Event { .. }, Some(hz), _) => (hz, DemandSource::Stated),
        (ScheduleSpec::Event { .. }, None, Some(used)) => (used.wakes, DemandSource::Measured),
        (ScheduleSpec::Event { .. }, None, None) => {
            let is_large = manifest.event_input().is_some_and(|it| it.type_name.is_large());
            (if is_large { LARGE_RATE } else { SMALL_RATE }, DemandSource::Assumed)
        }
    };
    WakeRate { hz, source }
}

/// Chooses the number that counts: the stated one, unless more was measured; else the measured
/// one; else the assumed one.
fn choose(stated: Option<Asked>, used: Option<f64>, assumed: impl FnOnce() -> Asked) -> Asked {
    let chosen = match (stated, used) {
        (Some(stated), Some(used)) if used > stated.amount => {
            let is_stated = stated.source == DemandSource::Stated;
            let most = stated.amount * TOLERANCE + TOLERANCE_CORES;
            let factors = format!("its busiest minute, above {}", stated.source());
            Asked {
                exceeds: is_stated && used > most,
                ..Asked::new(used, DemandSource::Measured, factors)
            }
        }
        (Some(stated), _) => stated,
        (None, Some(used)) => {
            Asked::new(used, DemandSource::Measured, "its busiest minute".to_owned())
        }
        (None, None) => assumed(),
    };
    Asked { peak: used, ..chosen }
}

/// Returns the memory that a lambda may take: its own, as much again for frames and tensors, its
/// scratch space, its preroll in memory, and its process.
fn memory(manifest: &Manifest) -> Asked {
    let limits = &manifest.limits;
    let process = match manifest.lambda.kind {
        LambdaKind::Wasm => WASM_PROCESS,
        LambdaKind::Python => PYTHON_PROCESS,
    };
    let in_memory = manifest.record.iter().filter(|record| record.store == Store::Ram);
    let preroll = in_memory.map(|record| record.preroll_size.bytes()).sum();
    let parts = [2 * limits.memory.bytes(), limits.scratch.bytes(), preroll, process.bytes()];
    Asked::new(parts.iter().sum::<u64>() as f64, DemandSource::Limits, String::new())
}

/// Formats a number, small ones with a fraction.
fn rounded(number: f64) -> String {
    match number {
        100.0.. => format!("{number:.0}"),
        _ => format!("{number:.2}").trim_end_matches('0').trim_end_matches('.').to_owned(),
    }
}
