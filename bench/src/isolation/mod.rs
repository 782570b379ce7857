//! What holds between lambdas: how late a lambda answers while another one misbehaves on another
//! core. And what a process costs.
//!
//! The victim and the player that feeds it are on one core, with this process; the attacker, with
//! all that reads its reports, is on another one. All of them run all the time: the attacker looks
//! at the clock, and attacks in every second block of time.

mod attacker;
mod blocks;
mod start;
mod victim;

use gleaner_dds::{Dds, Options};
use gleaner_tests::live::play;
use gleaner_transport::{Clock, LiveSource};

use self::attacker::{ATTACKS, Attacker};
use self::blocks::Course;
use self::victim::Victim;
use crate::measure::{Figure, Kind, cores, stay_on};

/// Pairs of blocks for each attack.
const PAIRS: usize = 20;
/// Processes of each kind that are started.
const STARTS: usize = 21;
/// Samples of the IMU each second, and what the player takes for it.
const RATE_HZ: f64 = 500.0;
const RATE: &str = "500";

/// All figures; the reason where there can be none.
pub fn figures(quick: bool) -> Result<Vec<Figure>, String> {
    let cores = cores()
        .map_err(|error| format!("the system does not tell which cores may be used: {error}"))?;
    let [ours, theirs, ..] = cores[..] else {
        return Err("victim and attacker need a core each".to_owned());
    };
    let mut figures = Vec::new();
    start::figures(if quick { 1 } else { STARTS }, &mut figures);
    stay_on(ours).map_err(|error| format!("cannot stay on one core: {error}"))?;
    attacks(quick, theirs, &mut figures);
    Ok(figures)
}

/// A victim of each kind through all attacks, the attacker on the core `theirs`.
fn attacks(quick: bool, theirs: usize, figures: &mut Vec<Figure>) {
    let clock = Clock::of_today();
    let mut victims = [Kind::Rust, Kind::Python].map(Victim::start);
    let readers = victims.len().to_string();
    // Far longer than this takes: it is told when to stop.
    let player =
        play(&["--imu", RATE, "--stamp", "monotonic", "--wait", &readers, "--duration", "36000"]);
    victims.iter().for_each(Victim::until_fed);
    for attack in ATTACKS.iter().filter(|attack| !quick || attack.is_quick()) {
        // A new one for each attack, so that one that dies costs no more than that.
        let mut dds = Dds::open(Options::new("/gleaner_bench/answers"))
            .expect("a private network can be joined");
        let mut attacker = Attacker::start(attack, theirs);
        victims.iter_mut().for_each(|victim| victim.hear(&mut dds));
        let course = Course::after(clock.now(), if quick { 1 } else { PAIRS });
        let course = &course;
        std::thread::scope(|scope| {
            for victim in &mut victims {
                scope.spawn(move || victim.listen(course, clock));
            }
            attacker.attack(course, clock);
        });
        for victim in &mut victims {
            victim.figures(attack, course, clock, figures);
        }
        attacker.end(course, figures);
        assert_eq!(dds.health().dead, None, "answers were not heard during: {attack}");
    }
    player.signal("INT");
    let played = player.finish();
    assert!(played.status.success(), "{}", played.said);
    victims.into_iter().for_each(|victim| victim.end(figures));
}
