//! Round trips from a sample to its answer, by the protocol of the paper: a warm-up and a measured
//! time, three times, for each side in turns. All sides have the same sender and the same recorder.
//!
//! - `workload`: what is answered, and by whom. `comparison`: the turns of the sides of a workload.
//! - `sides`: one side, for one turn. `node`: programs without Gleaner, of which `native` is one.
//! - `buffers`: the system's limit of socket buffers. `core_split`: cores of the sides, and others.
//! - `decisions`: all sides decide alike. `goals`: the promises. `progress`: the time that is left.

mod buffers;
mod comparison;
mod core_split;
mod decisions;
mod goals;
mod native;
mod node;
mod progress;
mod sides;
mod workload;

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_bench::{BenchResults, CoreList, EnergyMeter};
use gleaner_test_support::random::XorShift64;

use crate::live::BusyCores;
use crate::measure::{caught, shuffled};
use buffers::BufferLimit;
use comparison::Comparison;
use core_split::{CoreSplit, cores_of_sides};
pub use native::{NodeOptions, run_node};
use node::{NodeKind, NodeSide};
use progress::TurnProgress;
use sides::Side;
pub(crate) use workload::Workload;

/// Topic of all answers.
const ANSWERS: &str = "/rtt/answers";

/// The fact of the results that states the options of the run.
const OPTIONS: &str = "options";

/// Stores the results so far.
type Save<'a> = &'a mut dyn FnMut(&BenchResults) -> Result<(), Failure>;

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
    /// Only this workload; may be repeated [default: all, or those of the paper].
    #[arg(long, visible_alias = "only", value_name = "NAME")]
    workload: Vec<Workload>,
    /// Cores of all sides, such as 2-5 or 0,2; the sender and the recorder run on the others, if
    /// there are others [default: all run on all].
    #[arg(long, value_name = "LIST", value_parser = cores_of_sides)]
    cpus: Option<CoreList>,
    /// Lambdas also run with real-time priority of what receives, as by `gleaner run --real-time`.
    #[arg(long)]
    real_time: bool,
    /// Continue an interrupted run with the same options: what has results is skipped.
    #[arg(long)]
    pub resume: bool,
}

impl RttOptions {
    /// Returns the options that affect what is measured.
    fn text(&self, bench: &str) -> String {
        let Self { warm_up, turn, turns, seed, .. } = self;
        let mut text =
            format!("{bench} --warm-up {warm_up} --turn {turn} --turns {turns} --seed {seed}");
        text += &self.cpus.as_ref().map(|cpus| format!(" --cpus {cpus}")).unwrap_or_default();
        text + if self.real_time { " --real-time" } else { "" }
    }
}

/// A workload with a limit of socket buffers; `None` leaves the one that there is.
type RttRow = (Workload, Option<u64>);

/// Measures all workloads, and stores the results after each.
///
/// # Errors
///
/// Results that cannot be stored, or are not of a run with these options.
pub fn measure(
    quick: bool,
    options: &RttOptions,
    results: &mut BenchResults,
    save: Save<'_>,
) -> Result<(), Failure> {
    let workloads = match &options.workload[..] {
        [] if quick => vec![Workload::Empty, Workload::ImuSpectrum, Workload::Brake720],
        [] => Workload::ALL.to_vec(),
        some => some.to_vec(),
    };
    let rows = workloads.into_iter().flat_map(|workload| {
        let buffers = if quick { vec![None] } else { workload.buffers() };
        buffers.into_iter().map(move |bytes| (workload, bytes))
    });
    let sides = |workload: Workload, granted, _: &mut _| workload.sides(granted, options.real_time);
    run(quick, options, &rows.collect::<Vec<_>>(), &sides, results, save)
}

/// Measures the workloads of the paper: native, as a lambda in Python, and in wasm.
///
/// # Errors
///
/// As [`measure`].
pub fn paper(
    quick: bool,
    options: &RttOptions,
    results: &mut BenchResults,
    save: Save<'_>,
) -> Result<(), Failure> {
    let workloads =
        if options.workload.is_empty() { &Workload::PAPER[..] } else { &options.workload };
    let largest = |workload: &Workload| workload.buffers().last().copied().flatten();
    let rows: Vec<RttRow> =
        workloads.iter().map(|workload| (*workload, largest(workload))).collect();
    let sides = |workload: Workload, granted, results: &mut BenchResults| {
        sides_of_paper(workload.sides(granted, options.real_time), workload, granted, results)
    };
    run(quick, options, &rows, &sides, results, save)
}

/// Returns those of `sides` that the paper compares. The stand-in takes the place of rclpy where
/// that cannot run.
fn sides_of_paper(
    mut sides: Vec<Side>,
    workload: Workload,
    granted: u64,
    results: &mut BenchResults,
) -> Vec<Side> {
    let rclpy = NodeSide { kind: NodeKind::Rclpy, depth: NodeSide::DEPTH, buffer: granted };
    let native = match caught(|| rclpy.start(workload).map(drop)) {
        Ok(Ok(())) => NodeSide::RCLPY,
        Ok(Err(why)) | Err(why) => {
            note(results, format!("{}: skipped: {why}", NodeSide::RCLPY));
            NodeSide::STAND_IN
        }
    };
    // Native Rust has the arithmetic of the lambda in wasm: what it lacks is the isolation.
    let wanted = [native, NodeSide::RUST, "lambda, Python", "lambda, wasm"];
    let is_wanted = |name: &str| wanted.contains(&name);
    sides.retain(|side| is_wanted(side.name().trim_end_matches(", in real time")));
    sides
}

/// Measures rows, each with the sides that `sides` returns for a granted socket buffer.
fn run(
    quick: bool,
    options: &RttOptions,
    rows: &[RttRow],
    sides: &dyn Fn(Workload, u64, &mut BenchResults) -> Vec<Side>,
    results: &mut BenchResults,
    save: Save<'_>,
) -> Result<(), Failure> {
    let mut options = options.clone();
    if quick {
        (options.warm_up, options.turn, options.turns) = (1, 2, 1);
    }
    check_options(&options, results)?;
    let split = CoreSplit::of(options.cpus.as_ref()).expect("the command line was checked");
    let meter = EnergyMeter::of_this_machine();
    add_notes(&options, &split, &meter, results);
    let limit = BufferLimit::of_this_machine();
    let mut random = XorShift64(options.seed.max(1));
    let mut progress = TurnProgress::new(rows.len(), options.warm_up + options.turn);
    for &(workload, bytes) in rows {
        progress.rows_left -= 1;
        if let Some(Err(why)) = bytes.map(|bytes| limit.set(bytes)) {
            let name = format!("{workload:?} with {} B", bytes.unwrap_or_default());
            // The only row of a workload is measured with what the system grants.
            if rows.iter().filter(|row| row.0 == workload).count() > 1 {
                note(results, format!("{name} is skipped: {why}"));
                continue;
            }
            note(results, format!("{name} is measured with fewer: {why}"));
        }
        let granted = limit.bytes();
        let name = workload.title(granted);
        if results.groups.iter().any(|group| group.name == name) {
            eprintln!("done before: {name}");
            continue;
        }
        let is_awake = workload == Workload::EmptyAwake;
        let busy = is_awake.then(|| split.for_all(BusyCores::start));
        if let Some(Err(error)) = &busy {
            note(results, format!("{name} is skipped: no busy cores: {error}"));
            continue;
        }
        let sides = sides(workload, granted, results);
        let order = (0..options.turns).map(|_| shuffled(sides.len(), &mut random)).collect();
        let comparison = Comparison { workload, name, granted, order, options: &options };
        comparison.measure(&sides, (&split, &meter), &mut progress, results);
        save(results)?;
    }
    Ok(())
}

/// States the options in new results; those of a resumed run must be equal.
fn check_options(options: &RttOptions, results: &mut BenchResults) -> Result<(), Failure> {
    let text = options.text(&results.bench);
    let before = results.machine.facts.get(OPTIONS);
    if options.resume && before != Some(&text) {
        let before = before.map_or("unknown options", String::as_str);
        let message = format!("cannot resume `{text}`: the stored results are of `{before}`");
        return Err(Failure::new(Exit::Usage, message)
            .with_help("repeat the options of the stored results, or leave --resume out"));
    }
    results.machine.add(OPTIONS, Some(text));
    Ok(())
}

fn add_notes(
    options: &RttOptions,
    split: &CoreSplit,
    meter: &EnergyMeter,
    results: &mut BenchResults,
) {
    let RttOptions { warm_up, turn, turns, seed, .. } = options;
    let lengths = format!(
        "{turns} turns of {turn} s after a warm-up of {warm_up} s for each side, in an order by \
         the seed {seed}; each side is started again for each turn. *Answered of sent* includes \
         the warm-up."
    );
    note(results, lengths);
    for text in [
        "A round trip is the time from the stamp that the sender writes, of CLOCK_MONOTONIC, to \
         the stamp of the answer, just before it is sent. The arrival of the answer is the time at \
         which the recorder receives it.",
        "*Decisions that differ* are those of the turns in which each sample woke the side.",
    ] {
        note(results, text.to_owned());
    }
    if options.cpus.is_some() {
        note(results, split.note());
    }
    if !meter.is_available() {
        let text = "Power is skipped: no RAPL and no INA3221 can be read on this machine.";
        note(results, text.to_owned());
    }
}

/// Adds a note, once.
fn note(results: &mut BenchResults, text: String) {
    if !results.notes.contains(&text) {
        results.notes.push(text);
    }
}
