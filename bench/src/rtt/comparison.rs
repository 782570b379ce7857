//! The comparison of the sides of a workload: they take turns.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use gleaner_bench::{
    BenchResults, EnergyMeter, Figure, Growth, GrowthCurve, PartEnergy, Reception, Series,
    SeriesGroup,
};
use gleaner_dds::{Dds, DdsOptions};

use super::core_split::CoreSplit;
use super::node::NodeSide;
use super::progress::TurnProgress;
use super::sides::{Side, Turn, TurnConditions};
use super::workload::Workload;
use super::{ANSWERS, RttOptions, decisions, goals, note};
use crate::answers::{RttAnswer, RttReceiver};
use crate::measure::caught;

/// Longest time for which the machine is watched while nothing runs, in s.
const MAX_IDLE: u32 = 10;

/// A workload under one limit of socket buffers.
pub(super) struct Comparison<'a> {
    pub(super) workload: Workload,
    pub(super) name: String,
    /// The limit, in bytes.
    pub(super) granted: u64,
    /// The sides by their index in the order of each round.
    pub(super) order: Vec<Vec<usize>>,
    pub(super) options: &'a RttOptions,
}

/// Turns by the index of their side.
type Turns = BTreeMap<usize, Vec<Turn>>;

/// The failure of a turn by the index of its side, which has no turns after it.
type FailedTurns = BTreeMap<usize, String>;

impl Comparison<'_> {
    /// Lets the sides take turns, and adds them to the results.
    pub(super) fn measure(
        &self,
        sides: &[Side],
        machine: (&CoreSplit, &EnergyMeter),
        progress: &mut TurnProgress,
        results: &mut BenchResults,
    ) {
        let idle = self.idle(machine.1, results);
        let (turns, failed) = self.turns(sides, machine, &idle, progress, results);
        let all = || turns.iter().map(|(index, turns)| (&sides[*index], &turns[..]));
        self.add_faults(sides, (&turns, &failed), results);
        if turns.is_empty() {
            return;
        }
        if self.workload.has_equal_decisions() {
            let deciding = all().filter(|(side, _)| !side.is_bare()).flat_map(|(side, turns)| {
                let name = move |number| format!("{}, turn {number}", side.name());
                turns.iter().zip(1..).map(move |(turn, number)| (name(number), turn))
            });
            decisions::compare(self.workload, &self.name, deciding, results);
        }
        let group = turns
            .iter()
            .map(|(index, turns)| series(sides[*index].name(), turns, failed.get(index)));
        let group = self.group(&self.name, group);
        self.note_libraries(&group, results);
        goals::of_group(self.workload, self.granted, &group, &mut results.figures);
        for ((side, turns), series) in all().zip(&group.series) {
            let last = turns.last().expect("a side without turns has no entry");
            let last = (last, series.invalid.is_empty());
            side.stages(self.workload, &self.name, last, &mut results.figures);
        }
        let curves = all().filter_map(|(side, turns)| {
            let points = turns.last()?.memory.clone();
            (!points.is_empty()).then_some(GrowthCurve { name: side.name(), points })
        });
        results.growths.push(Growth {
            name: format!("{}: memory (PSS) in the last turn", self.name),
            of: "seconds".to_owned(),
            unit: "MB".to_owned(),
            curves: curves.collect(),
        });
        let arrivals = all().zip(&group.series).map(|((_, turns), series)| {
            let ms = |answer: &RttAnswer| (answer.arrived_ns - answer.stamp_ns()) as f64 / 1e6;
            let Series { name, turns: lengths, invalid, .. } = series.clone();
            Series { name, values: values(turns, ms), turns: lengths, invalid, ..Series::default() }
        });
        let name = format!("{}: arrival of the answer at the recorder", self.name);
        let arrivals = self.group(&name, arrivals);
        results.groups.extend([group, arrivals]);
    }

    /// Adds the failures and the faults of lambdas, and notes on costs that are absent.
    fn add_faults(
        &self,
        sides: &[Side],
        (turns, failed): (&Turns, &FailedTurns),
        results: &mut BenchResults,
    ) {
        for (index, side) in sides.iter().enumerate() {
            let name = |what: &str| format!("{}, {}: {what}", self.name, side.name());
            let turns = turns.get(&index).map_or(&[][..], Vec::as_slice);
            for why in turns.iter().flat_map(|turn| &turn.absent) {
                note(results, name(why));
            }
            // Of a run that is resumed.
            results.figures.retain(|row| row.name != name("failed turns"));
            if side.is_lambda() && failed.contains_key(&index) {
                // There are no turns after it.
                results.figures.push(Figure::at_most(&name("failed turns"), "turns", 0.0, &[1.0]));
            }
            if side.is_lambda() && !turns.is_empty() {
                let faults = turns.iter().map(Turn::faults).sum::<u64>() as f64;
                let name = name("faults and restarts");
                results.figures.push(Figure::at_most(&name, "", 0.0, &[faults]));
            }
        }
    }

    /// Adds a note if the sides run their model by different libraries.
    fn note_libraries(&self, group: &SeriesGroup, results: &mut BenchResults) {
        let models = group.series.iter().filter_map(|series| series.details.get("model"));
        // NAME VERSION, and then the provider and the threads.
        let names = models.filter_map(|model| model.split(',').next()).collect::<BTreeSet<_>>();
        if names.len() > 1 {
            let by = format!("by different libraries ({})", Vec::from_iter(names).join(", "));
            let text = format!("the sides run the model {by}: their times compare these, too.");
            note(results, format!("{}: {text}", self.name));
        }
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
        sides: &[Side],
        (split, meter): (&CoreSplit, &EnergyMeter),
        idle: &[PartEnergy],
        progress: &mut TurnProgress,
        results: &mut BenchResults,
    ) -> (Turns, FailedTurns) {
        let mut dds =
            Dds::open(DdsOptions::new("/gleaner_bench/answers")).expect("a private network");
        let answers = RttReceiver::on(&mut dds, ANSWERS);
        let RttOptions { warm_up, turn: measured, turns: rounds, .. } = *self.options;
        let (workload, seconds) = (self.workload, [warm_up, measured]);
        let conditions =
            TurnConditions { workload, answers: &answers, split, meter, idle, seconds };
        let (mut turns, mut failed) = (Turns::new(), FailedTurns::new());
        let mut given_up = BTreeSet::new();
        let (mut number, count) = (0, rounds * sides.len() as u32);
        for (round, order) in (1..).zip(&self.order) {
            for &index in order {
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
                    Ok(Err(why)) if round == 1 => format!("{side}: skipped: {why}"),
                    Ok(Err(why)) | Err(why) => {
                        let first = why.lines().next().unwrap_or_default();
                        failed.insert(index, format!("turn {round} failed: {first}"));
                        format!("{}, {side}: failed: {why}", self.name)
                    }
                };
                eprintln!("{why}");
                note(results, why);
                given_up.insert(index);
            }
        }
        (turns, failed)
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
fn series(name: String, turns: &[Turn], failed: Option<&String>) -> Series {
    let mut costs: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for (cost, value) in turns.iter().flat_map(|turn| &turn.costs) {
        costs.entry(cost.clone()).or_default().push(*value);
    }
    let invalid = turns.iter().zip(1..).flat_map(|(turn, number)| {
        turn.invalid.iter().map(move |why| format!("turn {number}: {why}"))
    });
    let sent = turns.iter().map(|turn| turn.sent).sum();
    let answered = turns.iter().map(|turn| turn.answers.len() as u64).sum();
    Series {
        name,
        details: turns.last().map(|turn| turn.facts.clone()).unwrap_or_default(),
        reception: Some(Reception { sent, answered }),
        values: values(turns, |answer| answer.ns / 1e6),
        turns: turns.iter().map(|turn| turn.counted().count()).collect(),
        costs,
        invalid: invalid.chain(failed.cloned()).collect(),
    }
}

/// Returns a value of each answer after the warm-ups.
fn values(turns: &[Turn], of: impl Fn(&RttAnswer) -> f64) -> Vec<f64> {
    turns.iter().flat_map(Turn::counted).map(of).collect()
}
