//! Use of resources by the lambdas of this vehicle, and the speed of the machine, in a file that
//! survives restarts. Without the file, all is measured again.

use std::collections::{BTreeMap, BTreeSet};

use gleaner_lambda::manifest::Sha256;
use gleaner_protocol::LiveStatus;
use gleaner_protocol::inference::LoadedModel;
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus, SupervisorStatus};
use serde::{Deserialize, Serialize};

use super::demand::DemandModel;
use crate::durable::DurableFile;

/// Length of a measurement, in s: short enough to see a busy time, long enough for slow wakes.
const WINDOW: f64 = 60.0;
/// Length from which the current measurement is shown, in s.
const SHOWN: f64 = 5.0;
/// Growth from which a number is written again.
const GROWTH: f64 = 1.1;
/// Runs of a model from which their mean counts.
const RUNS: u64 = 20;
/// Fuel units per second until the machine is measured: less than any machine took so far, so that
/// a demand is rather too large.
const ASSUMED_FUEL_PER_S: f64 = 5e8;

/// The use of a revision in its busiest minute.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct MeasuredUse {
    /// CPU time, in cores.
    pub(crate) cpu: f64,
    /// Wakes per second.
    pub(crate) wakes: f64,
    /// Time of its models, in s/s.
    pub(crate) model_time: f64,
    /// True if a warning reported that it uses more than it states.
    #[serde(default)]
    pub(crate) is_reported: bool,
}

/// Use of resources by all lambdas, now.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct CurrentUse {
    /// Memory, in bytes.
    pub(crate) memory: Option<f64>,
    /// CPU time, in cores.
    pub(crate) cpu: Option<f64>,
    /// Time of models, in s/s.
    pub(crate) model_time: Option<f64>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct MeasuredFile {
    /// The machine, and its speed in fuel units per second.
    machine: Option<(String, f64)>,
    /// Uses, by the digest of the revision.
    uses: BTreeMap<Sha256, MeasuredUse>,
    /// Mean run times of models, in s, by the digests of their files.
    models: BTreeMap<Sha256, f64>,
}

#[derive(Debug)]
pub(crate) struct Measurements {
    file: DurableFile,
    now: MeasuredFile,
    /// As it is in the file.
    saved: MeasuredFile,
    windows: BTreeMap<String, Window>,
}

/// The current measurement of a lambda.
#[derive(Debug)]
struct Window {
    first: Sample,
    newest: Sample,
    last: Option<MeasuredUse>,
}

#[derive(Debug, Clone, PartialEq)]
struct Sample {
    /// Revision, attempt and restarts: the counts go on while these are equal.
    process: (String, u64, u32),
    up_s: f64,
    cpu_s: f64,
    wakes: u64,
    /// Runs of its models and their time in s, of all lambdas, by the digest of the file.
    models: BTreeMap<String, (u64, f64)>,
}

impl Measurements {
    /// Loads the file; also returns the reason why it could not be used.
    pub(crate) fn load(file: DurableFile) -> (Self, Option<String>) {
        let (mut now, damage) = match file.load::<MeasuredFile>() {
            Ok(loaded) => (loaded.value.unwrap_or_default(), loaded.damage),
            Err(failure) => {
                let failure = failure.with_help("nothing is to be done: all is measured again");
                (MeasuredFile::default(), Some(failure.to_string()))
            }
        };
        // No machine measures others: sums of them would not be numbers.
        let is_sound = |value: &f64| (0.0..=1e15).contains(value);
        now.uses.retain(|_, used| [used.cpu, used.wakes, used.model_time].iter().all(is_sound));
        now.models.retain(|_, time| is_sound(time));
        now.machine = now.machine.filter(|(_, speed)| *speed >= 1.0 && is_sound(speed));
        (Self { file, saved: now.clone(), now, windows: BTreeMap::new() }, damage)
    }

    /// Returns what is known, to calculate demands.
    pub(crate) fn model(&self) -> DemandModel<'_> {
        let fuel_per_s = self.now.machine.as_ref().map_or(ASSUMED_FUEL_PER_S, |(_, speed)| *speed);
        DemandModel { fuel_per_s, uses: &self.now.uses, models: &self.now.models }
    }

    pub(crate) fn has_speed_of(&self, machine: &str) -> bool {
        self.now.machine.as_ref().is_some_and(|(known, _)| known == machine)
    }

    /// Notes the speed of the machine, in fuel units per second.
    pub(crate) fn set_speed(&mut self, machine: String, fuel_per_s: f64) {
        self.now.machine = Some((machine, fuel_per_s));
        self.save();
    }

    /// Notes that a warning reported the use of a revision; returns false if one did before.
    pub(crate) fn report(&mut self, revision: &Sha256) -> bool {
        let known = self.now.uses.get_mut(revision);
        known.is_some_and(|known| !std::mem::replace(&mut known.is_reported, true))
    }

    /// Adds a status. Returns whether a measurement is complete.
    pub(crate) fn observe(&mut self, status: &SupervisorStatus) -> bool {
        let models = status.inference.iter().filter_map(|it| it.last.as_ref());
        let models: Vec<&LoadedModel> = models.flat_map(|last| &last.models).collect();
        for model in &models {
            let digest = model.sha256.parse::<Sha256>().ok().filter(|_| model.runs >= RUNS);
            if let Some(digest) = digest {
                self.now.models.insert(digest, model.run_ns as f64 / 1e9 / model.runs as f64);
            }
        }
        let mut is_complete = false;
        let mut measured = BTreeSet::new();
        for lambda in &status.lambdas {
            let running = lambda.live.as_deref().filter(|_| lambda.phase == LambdaPhase::Running);
            let Some(live) = running else { continue };
            measured.insert(lambda.id.clone());
            let sample = Sample::of(lambda, live, &models);
            let fresh = || Window { first: sample.clone(), newest: sample.clone(), last: None };
            let window = self.windows.entry(lambda.id.clone()).or_insert_with(fresh);
            if window.first.process != sample.process || sample.up_s < window.first.up_s {
                *window = fresh();
            }
            window.newest = sample;
            if window.newest.up_s - window.first.up_s >= WINDOW {
                let used = window.use_so_far();
                (window.first, window.last) = (window.newest.clone(), Some(used));
                if let Ok(digest) = lambda.revision.parse::<Sha256>() {
                    let peak = self.now.uses.entry(digest).or_default();
                    peak.cpu = peak.cpu.max(used.cpu);
                    peak.wakes = peak.wakes.max(used.wakes);
                    peak.model_time = peak.model_time.max(used.model_time);
                    is_complete = true;
                }
            }
        }
        self.windows.retain(|id, _| measured.contains(id));
        is_complete
    }

    pub(crate) fn current(&self, status: &SupervisorStatus) -> CurrentUse {
        let uses: Vec<_> = self.windows.values().filter_map(Window::current).collect();
        let sum = |part: fn(&MeasuredUse) -> f64| {
            (!uses.is_empty()).then(|| uses.iter().map(part).sum::<f64>())
        };
        let running = status.lambdas.iter().filter(|lambda| lambda.phase == LambdaPhase::Running);
        let live = running.filter_map(|lambda| lambda.live.as_deref());
        let resident: u64 = live.map(|live| live.rss_bytes).sum();
        CurrentUse {
            memory: (resident > 0).then_some(resident as f64),
            cpu: sum(|used| used.cpu),
            model_time: sum(|used| used.model_time),
        }
    }

    /// Forgets revisions and models that are in neither set.
    pub(crate) fn retain(&mut self, revisions: &BTreeSet<Sha256>, models: &BTreeSet<Sha256>) {
        self.now.uses.retain(|digest, _| revisions.contains(digest));
        self.now.models.retain(|digest, _| models.contains(digest));
    }

    /// Writes the file, if that is worth it.
    pub(crate) fn save_if_changed(&mut self) {
        let is_new = |now: f64, saved: Option<f64>| {
            saved.is_none_or(|saved| now > saved * GROWTH || saved > now * GROWTH)
        };
        let (now, saved) = (&self.now, &self.saved);
        let uses = now.uses.iter().any(|(digest, used)| {
            let saved = saved.uses.get(digest);
            is_new(used.cpu, saved.map(|saved| saved.cpu))
                || is_new(used.wakes, saved.map(|saved| saved.wakes))
                || is_new(used.model_time, saved.map(|saved| saved.model_time))
                || saved.is_some_and(|saved| saved.is_reported != used.is_reported)
        });
        let mut models = now.models.iter();
        let models = models.any(|(digest, time)| is_new(*time, saved.models.get(digest).copied()));
        if uses || models {
            self.save();
        }
    }

    fn save(&mut self) {
        match self.file.save(&self.now) {
            Ok(()) => self.saved = self.now.clone(),
            // It is tried again after the next measurement.
            Err(failure) => tracing::warn!(%failure, "could not save measured loads"),
        }
    }
}

impl Window {
    fn current(&self) -> Option<MeasuredUse> {
        let is_long = self.newest.up_s - self.first.up_s >= SHOWN;
        self.last.or_else(|| is_long.then(|| self.use_so_far()))
    }

    fn use_so_far(&self) -> MeasuredUse {
        let (first, newest) = (&self.first, &self.newest);
        let seconds = (newest.up_s - first.up_s).max(f64::MIN_POSITIVE);
        let wakes = newest.wakes.saturating_sub(first.wakes) as f64;
        // Reports have the runs of all lambdas: one that shares a model counts with a run for each
        // wake, at most.
        let models = newest.models.iter().map(|(digest, (runs, time))| {
            let (before_runs, before_time) = first.models.get(digest).copied().unwrap_or_default();
            let runs = runs.saturating_sub(before_runs) as f64;
            let time = (time - before_time).max(0.0);
            if runs > wakes { time / runs * wakes } else { time }
        });
        MeasuredUse {
            cpu: (newest.cpu_s - first.cpu_s).max(0.0) / seconds,
            wakes: wakes / seconds,
            // A sum of no fractions is -0.
            model_time: (models.sum::<f64>() + 0.0) / seconds,
            is_reported: false,
        }
    }
}

impl Sample {
    fn of(lambda: &LambdaStatus, live: &LiveStatus, models: &[&LoadedModel]) -> Self {
        let own = models.iter().filter(|model| model.lambdas.contains(&lambda.name));
        Self {
            process: (lambda.revision.clone(), lambda.attempt, lambda.restarts),
            up_s: live.up_s,
            cpu_s: live.cpu_s,
            wakes: live.wakes,
            models: own.map(|it| (it.sha256.clone(), (it.runs, it.run_ns as f64 / 1e9))).collect(),
        }
    }
}
