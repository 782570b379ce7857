//! Measures isolation: what each way of it costs (`costs`, `start`), and how much later a lambda
//! answers while another one misbehaves on another core.
//!
//! The victim, the player that feeds it and this process share one core. The attacker, with all
//! that reads its reports, is on another one. All of them run all the time: the attacker reads the
//! clock and attacks in every second block of time.

mod attacker;
mod blocks;
mod costs;
mod start;
mod victim;

use clap::Args;
use gleaner_bench::{BenchResults, Figure};
use gleaner_dds::{Dds, DdsOptions};
use gleaner_messages::transport::{Clock, LiveSource};
use gleaner_tests::live::play;

use self::attacker::{ATTACKS, Attacker};
use self::blocks::BlockSchedule;
pub use self::costs::{BenchGuest, run_as_runtime};
use self::victim::Victim;
use crate::measure::{Twin, bind_to, cores};

/// Pairs of blocks for each attack.
const PAIRS: usize = 20;
/// Processes of each kind that are started.
const STARTS: usize = 21;
/// Rate of the IMU in samples per second, as a number and as the player's argument.
const RATE_HZ: f64 = 500.0;
const RATE: &str = "500";

/// The parts of a run.
#[derive(Args, Clone)]
pub struct IsolationOptions {
    /// Measure only the costs of each kind, not the attacks, which take 25 minutes.
    #[arg(long)]
    no_attacks: bool,
    /// Selects the order of the sides in each turn.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl IsolationOptions {
    /// Returns whether a player feeds victims of attacks.
    pub fn has_attacks(&self) -> bool {
        !self.no_attacks
    }
}

/// Measures the start of a lambda of each kind.
pub fn starts(quick: bool, results: &mut BenchResults) {
    start::figures(if quick { 1 } else { STARTS }, &mut results.figures);
}

/// Measures everything. Without a second core, nothing is attacked.
pub fn measure(quick: bool, options: &IsolationOptions, results: &mut BenchResults) {
    costs::measure(quick, options.seed, results);
    starts(quick, results);
    if options.has_attacks()
        && let Err(why) = attacks(quick, &mut results.figures)
    {
        results.notes.push(format!("The attacks are skipped: {why}."));
    }
}

/// Runs all attacks, or returns the reason why they cannot be measured.
fn attacks(quick: bool, figures: &mut Vec<Figure>) -> Result<(), String> {
    let cores = cores().map_err(|error| format!("cannot determine the allowed cores: {error}"))?;
    let [own, attacker, ..] = cores[..] else {
        return Err("victim and attacker need one core each".to_owned());
    };
    bind_to([own]).map_err(|error| format!("cannot bind to one core: {error}"))?;
    on_victims(quick, attacker, figures);
    Ok(())
}

/// Runs all attacks on a victim of each kind, with the attacker on `core`.
fn on_victims(quick: bool, core: usize, figures: &mut Vec<Figure>) {
    let clock = Clock::from_time_of_day();
    let mut victims = [Twin::Rust, Twin::Python].map(Victim::start);
    let readers = victims.len().to_string();
    // Far longer than the bench: the player is stopped by a signal.
    let player =
        play(&["--imu", RATE, "--stamp", "monotonic", "--wait", &readers, "--duration", "36000"]);
    victims.iter().for_each(Victim::until_fed);
    for attack in ATTACKS.iter().filter(|attack| !quick || attack.is_quick()) {
        // A new participant for each attack, so that one that fails costs a single row.
        let mut dds = Dds::open(DdsOptions::new("/gleaner_bench/answers"))
            .expect("a private network can be joined");
        let mut attacker = Attacker::start(attack, core);
        victims.iter_mut().for_each(|victim| victim.subscribe(&mut dds));
        let schedule = BlockSchedule::after(clock.now(), if quick { 1 } else { PAIRS });
        let schedule = &schedule;
        std::thread::scope(|scope| {
            for victim in &mut victims {
                scope.spawn(move || victim.collect(schedule, clock));
            }
            attacker.attack(schedule, clock);
        });
        for victim in &mut victims {
            victim.figures(attack, schedule, clock, figures);
        }
        attacker.end(schedule, figures);
        assert_eq!(dds.health().dead, None, "the bench's participant died during: {attack}");
    }
    let played = player.interrupt();
    assert!(played.status.success(), "{}", played.stderr);
    victims.into_iter().for_each(|victim| victim.end(figures));
}
