//! The comparison of the sides of a workload: they take turns.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use gleaner_bench::{
    BenchResults, EnergyMeter, Growth, GrowthCurve, PartEnergy, Reception, Series, SeriesGroup,
};
use gleaner_dds::{Dds, DdsOptions};
use gleaner_test_support::random::XorShift64;

use super::core_split::CoreSplit;
use super::node::NodeSide;
use super::progress::TurnProgress;
use super::sides::{Side, Turn, TurnConditions};
use super::workload::Workload;
use super::{ANSWERS, RttOptions, decisions, goals, note};
use crate::answers::{RttAnswer, RttReceiver};
use crate::measure::{caught, shuffled};

/// Longest time for which the machine is watched while nothing runs, in s.
const MAX_IDLE: u32 = 10;

/// A workload under one limit of socket buffers.
pub(super) struct Comparison<'a> {
    pub(super) workload: Workload,
    pub(super) name: String,
    /// The limit, in bytes.
    pub(super) granted: u64,
    pub(super) options: &'a RttOptions,
}

/// Turns by the index of their side.
type Turns = BTreeMap<usize, Vec<Turn>>;

impl Comparison<'_> {
    /// Lets the sides take turns, and adds them to the results.
    pub(super) fn measure(
        &self,
        mut sides: Vec<Side>,
        machine: (&CoreSplit, &EnergyMeter),
        progress: &mut TurnProgress,
        results: &mut BenchResults,
    ) {
        let idle = self.idle(machine.1, results);
        let turns = self.turns(&mut sides, machine, &idle, progress, results);
        if turns.is_empty() {
            return;
        }
        if self.workload.has_equal_decisions() {
            let deciding = turns.iter().filter(|(index, _)| !sides[**index].is_bare());
            match decisions::differing(&self.name, deciding.flat_map(|(_, turns)| turns)) {
                Some(row) => results.figures.push(row),
                None => note(
                    results,
                    format!("{}: no decisions are compared: samples were lost.", self.name),
                ),
            }
        }
        let all = || turns.iter().map(|(index, turns)| (sides[*index].name(), &turns[..]));
        let group = self.group(&self.name, all().map(|(name, turns)| series(name, turns)));
        goals::of_group(self.workload, self.granted, &group, &mut results.figures);
        sides.iter().for_each(|side| side.stages(self.workload, &self.name, &mut results.figures));
        let curves = all().filter_map(|(name, turns)| {
            let points = turns.last()?.memory.clone();
            (!points.is_empty()).then_some(GrowthCurve { name, points })
        });
        results.growths.push(Growth {
            name: format!("{}: memory (PSS) in the last turn", self.name),
            of: "seconds".to_owned(),
            unit: "MB".to_owned(),
            curves: curves.collect(),
        });
        let arrivals = all().map(|(name, turns)| {
            let ms = |answer: &RttAnswer| (answer.arrived_ns - answer.stamp_ns()) as f64 / 1e6;
            Series { name, values: values(turns, ms), invalid: invalid(turns), ..Series::default() }
        });
        let name = format!("{}: arrival of the answer at the recorder", self.name);
        let arrivals = self.group(&name, arrivals);
        results.groups.extend([group, arrivals]);
    }

    /// Returns the energy while nothing runs; nothing without sensors.
    fn idle(&self, meter: &EnergyMeter, results: &mut BenchResults) -> Vec<PartEnergy> {
        if !meter.is_available() {
            return Vec::new();
        }
        let seconds = self.options.turn.min(MAX_IDLE);
        eprintln!("{}: idle power, {seconds} s", self.name);
        let idle = meter.watch(Duration::from_secs(seconds.into()), |_| {});
        let parts = idle.iter().map(|part| format!("{} {:.2} W", part.part, part.watts));
        let parts = parts.collect::<Vec<_>>().join(", ");
        note(results, format!("{}: idle power, before the first turn: {parts}.", self.name));
        idle
    }

    fn turns(
        &self,
        sides: &mut [Side],
        (split, meter): (&CoreSplit, &EnergyMeter),
        idle: &[PartEnergy],
        progress: &mut TurnProgress,
        results: &mut BenchResults,
    ) -> Turns {
        let mut dds =
            Dds::open(DdsOptions::new("/gleaner_bench/answers")).expect("a private network");
        let answers = RttReceiver::on(&mut dds, ANSWERS);
        let RttOptions { warm_up, turn: measured, turns: rounds, seed, .. } = *self.options;
        let (workload, seconds) = (self.workload, [warm_up, measured]);
        let conditions =
            TurnConditions { workload, answers: &answers, split, meter, idle, seconds };
        let (mut turns, mut given_up) = (Turns::new(), BTreeSet::new());
        let mut random = XorShift64(seed.max(1));
        let (mut number, count) = (0, rounds * sides.len() as u32);
        for round in 1..=rounds {
            for index in shuffled(sides.len(), &mut random) {
                number += 1;
                if given_up.contains(&index) {
                    continue;
                }
                let side = sides[index].name();
                let what = format!("{}: {side}, turn {round} of {rounds}", self.name);
                progress.begin_turn([number, count], &what);
                let began = Instant::now();
                let why = match caught(|| sides[index].turn(&conditions)) {
                    Ok(Ok(turn)) => {
                        progress.end_turn(began.elapsed());
                        turns.entry(index).or_default().push(turn);
                        continue;
                    }
                    Ok(Err(why)) => format!("{side}: skipped: {why}"),
                    Err(why) => format!("{}, {side}: failed: {why}", self.name),
                };
                eprintln!("{why}");
                note(results, why);
                given_up.insert(index);
            }
        }
        turns
    }

    fn group(&self, name: &str, series: impl Iterator<Item = Series>) -> SeriesGroup {
        let bases = [NodeSide::RCLPY, NodeSide::STAND_IN, NodeSide::BARE];
        SeriesGroup {
            name: name.to_owned(),
            unit: "ms".to_owned(),
            bases: bases.map(str::to_owned).to_vec(),
            series: series.collect(),
        }
    }
}

/// Returns the round trips of a side, and its costs.
fn series(name: String, turns: &[Turn]) -> Series {
    let mut costs: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for (cost, value) in turns.iter().flat_map(|turn| &turn.costs) {
        costs.entry(cost.clone()).or_default().push(*value);
    }
    let sent = turns.iter().map(|turn| turn.sent).sum();
    let answered = turns.iter().map(|turn| turn.answers.len() as u64).sum();
    Series {
        name,
        details: turns.last().map(|turn| turn.facts.clone()).unwrap_or_default(),
        reception: Some(Reception { sent, answered }),
        values: values(turns, |answer| answer.ns / 1e6),
        costs,
        invalid: invalid(turns),
    }
}

/// Returns a value of each answer after the warm-ups.
fn values(turns: &[Turn], of: impl Fn(&RttAnswer) -> f64) -> Vec<f64> {
    turns.iter().flat_map(Turn::counted).map(of).collect()
}

fn invalid(turns: &[Turn]) -> Vec<String> {
    let numbered = turns.iter().zip(1..).flat_map(|(turn, number)| {
        turn.invalid.iter().map(move |why| format!("turn {number}: {why}"))
    });
    numbered.collect()
}
