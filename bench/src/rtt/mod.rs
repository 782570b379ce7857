//! Round trips from a sample to its answer, by the protocol of the paper: a warm-up and a measured
//! time, three times, for each side in turns. All sides have the same sender and the same recorder.
//!
//! - `workload`: what is answered, and by whom. `sides`: one side of a comparison, for one turn.
//! - `bare`: a reader that only answers. `node`: a program that a user would write without Gleaner.
//! - `buffers`: the system's limit of socket buffers. `core_split`: cores of the sides, and others.
//! - `goals`: the promises.

mod bare;
mod buffers;
mod core_split;
mod goals;
mod node;
mod sides;
mod workload;

use std::collections::BTreeMap;
use std::sync::Arc;

use clap::Args;
use gleaner_bench_results::{
    BenchResults, CoreList, Growth, GrowthCurve, PowerMeter, Reception, Series, SeriesGroup,
    quantile,
};
use gleaner_dds::{Dds, DdsOptions};

use crate::answers::RttReceiver;
use crate::live::BusyCores;
use crate::measure::shuffled;
use buffers::BufferLimit;
use core_split::{CoreSplit, cores_of_sides};
use sides::{Side, Turn};
pub(crate) use workload::Workload;

/// Topic of all answers.
const ANSWERS: &str = "/rtt/answers";

/// The length of a run.
#[derive(Args, Clone)]
pub struct RttOptions {
    /// Time before each measured one, in s.
    #[arg(long, value_name = "S", default_value_t = 20)]
    warm_up: u32,
    /// Length of a measured time, in s.
    #[arg(long, value_name = "S", default_value_t = 20)]
    turn: u32,
    /// Number of measured times of each side.
    #[arg(long, value_name = "N", default_value_t = 3)]
    turns: u32,
    /// Selects the order of the sides in each turn.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Only this workload; may be repeated [default: all].
    #[arg(long, value_name = "NAME")]
    workload: Vec<Workload>,
    /// Cores of all sides, such as 2-5 or 0,2; the sender and the recorder run on the others, if
    /// there are others [default: all run on all].
    #[arg(long, value_name = "LIST", value_parser = cores_of_sides)]
    cpus: Option<CoreList>,
    /// Lambdas also run with real-time priority of what receives, as by `gleaner run --real-time`.
    #[arg(long)]
    real_time: bool,
}

/// Measures all workloads.
pub fn measure(quick: bool, options: &RttOptions, results: &mut BenchResults) {
    let mut options = options.clone();
    if quick {
        (options.warm_up, options.turn, options.turns) = (1, 2, 1);
    }
    let RttOptions { warm_up, turn, turns, seed, .. } = options;
    results.notes.push(format!(
        "{turns} turns of {turn} s after a warm-up of {warm_up} s for each side, in an order by the \
         seed {seed}; each side starts anew for each turn. *Answered of sent* includes the warm-up."
    ));
    results.notes.push(
        "A round trip is the time from the stamp that the sender writes, of CLOCK_MONOTONIC, to \
         the stamp of the answer, just before it is sent."
            .to_owned(),
    );
    let split = CoreSplit::of(options.cpus.as_ref()).expect("the command line was checked");
    results.notes.extend(options.cpus.is_some().then(|| split.note()));
    let meter = PowerMeter::of_this_machine();
    if !meter.is_available() {
        let note = "Power is skipped: no RAPL and no INA3221 can be read on this machine.";
        results.notes.push(note.to_owned());
    }
    let workloads = match &options.workload[..] {
        [] if quick => vec![Workload::Empty, Workload::ImuFft, Workload::Brake720],
        [] => Workload::ALL.to_vec(),
        some => some.to_vec(),
    };
    let limit = BufferLimit::of_this_machine();
    for workload in workloads {
        let rows = if quick { vec![None] } else { workload.buffers() };
        for bytes in rows {
            if let Some(bytes) = bytes
                && let Err(why) = limit.set(bytes)
            {
                results.notes.push(format!("{workload:?} with {bytes} B is skipped: {why}"));
                continue;
            }
            let granted = limit.bytes();
            let name = workload.title(granted);
            eprintln!("{name}");
            let is_awake = workload == Workload::EmptyAwake;
            let busy = is_awake.then(|| split.for_all(BusyCores::start));
            if let Some(Err(error)) = &busy {
                results.notes.push(format!("{name} is skipped: no busy cores: {error}"));
                continue;
            }
            compare(workload, name, granted, &options, (&split, &meter), results);
        }
    }
}

/// Lets the sides of a workload take turns, and adds them to the results.
fn compare(
    workload: Workload,
    name: String,
    granted: u64,
    options: &RttOptions,
    machine: (&CoreSplit, &PowerMeter),
    results: &mut BenchResults,
) {
    let mut dds = Dds::open(DdsOptions::new("/gleaner_bench/answers")).expect("a private network");
    let answers: Arc<RttReceiver> = RttReceiver::on(&mut dds, ANSWERS);
    let mut sides = workload.sides(granted, options.real_time);
    let mut turns: BTreeMap<usize, Vec<Turn>> = BTreeMap::new();
    let mut random = options.seed.max(1);
    let mut memory = Vec::new();
    for _ in 0..options.turns {
        for index in shuffled(sides.len(), &mut random) {
            let seconds = [options.warm_up, options.turn];
            match sides[index].turn(workload, &answers, machine, seconds) {
                Ok(turn) => turns.entry(index).or_default().push(turn),
                Err(why) => {
                    let note = format!("{}: skipped: {why}", sides[index].name());
                    if !results.notes.contains(&note) {
                        results.notes.push(note);
                    }
                }
            }
        }
    }
    let series = sides.iter_mut().enumerate().filter_map(|(index, side)| {
        let turns = turns.remove(&index)?;
        let points = turns.last()?.memory.clone();
        if !points.is_empty() {
            memory.push(GrowthCurve { name: side.name(), points });
        }
        let add = |count: fn(&Turn) -> u64| turns.iter().map(count).sum::<u64>();
        let reception =
            Reception { sent: add(|turn| turn.sent), answered: add(|turn| turn.answered) };
        let median = |number: fn(&Turn) -> Option<f64>| {
            let numbers: Vec<f64> = turns.iter().filter_map(number).collect();
            (!numbers.is_empty()).then(|| format!("{:.1}", quantile(&numbers, 0.5)))
        };
        let mut details = turns.last()?.facts.clone();
        for (name, value) in [
            ("CPU, % of a core", median(|turn| turn.cpu_percent)),
            ("memory (PSS), MB", median(|turn| turn.memory_mb)),
        ] {
            details.extend(value.map(|value| (name.to_owned(), value)));
        }
        for (part, _) in &turns.last()?.power_w {
            let of_part =
                |turn: &Turn| turn.power_w.iter().find(|(name, _)| name == part).map(|it| it.1);
            let watts: Vec<f64> = turns.iter().filter_map(of_part).collect();
            details.insert(format!("power of {part}, W"), format!("{:.2}", quantile(&watts, 0.5)));
        }
        let values = turns.iter().flat_map(|turn| turn.times_ms.iter().copied()).collect();
        Some(Series { name: side.name(), details, reception: Some(reception), values })
    });
    let series: Vec<Series> = series.collect();
    let base = Side::BARE.to_owned();
    let group = SeriesGroup { name, unit: "ms".to_owned(), base: Some(base), series };
    goals::of_group(workload, granted, &group, &mut results.figures);
    for side in &sides {
        side.stages(workload, &group.name, &mut results.figures);
    }
    if !memory.is_empty() {
        results.growths.push(Growth {
            name: format!("{}: memory (PSS) in the last turn", group.name),
            of: "seconds".to_owned(),
            unit: "MB".to_owned(),
            curves: memory,
        });
    }
    results.groups.push(group);
}
