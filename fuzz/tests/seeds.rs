//! Checks all seeds, unchanged and with random changes. One test only, because memory is counted
//! for the whole process.

use gleaner_fuzz::{TARGETS, Target};
use gleaner_test_support::random::XorShift64;

/// Number of inputs made from the seeds of a target: one or two seconds' worth. Twenty times as
/// many with `GLEANER_LONG=1`.
fn inputs(target: &Target) -> u32 {
    match target.name {
        "bag" => 1_000,
        "calls" => 8_000,
        "drive" | "trust" => 5_000,
        _ => 20_000,
    }
}

/// Changes seeds with xorshift64: the same inputs in each run.
struct SeedMutator(XorShift64);

impl SeedMutator {
    /// One of the seeds, with some bytes changed, removed, or replaced from another seed.
    fn mutate(&mut self, seeds: &[Vec<u8>], longest: usize) -> Vec<u8> {
        let mut bytes = seeds[self.0.below(seeds.len())].clone();
        for _ in 0..=self.0.below(4) {
            let (at, to) = (self.0.below(bytes.len() + 1), self.0.below(bytes.len() + 1));
            match self.0.below(4) {
                0 | 1 if at < bytes.len() => bytes[at] = self.0.below(256) as u8,
                2 => drop(bytes.drain(at.min(to)..at.max(to))),
                _ => {
                    let other = &seeds[self.0.below(seeds.len())];
                    bytes.truncate(at);
                    bytes.extend(&other[self.0.below(other.len() + 1)..]);
                }
            }
        }
        bytes.truncate(longest);
        bytes
    }
}

#[test]
fn all_seeds_pass_their_checks_whole_truncated_and_changed() {
    let times = if std::env::var("GLEANER_LONG").is_ok_and(|value| value == "1") { 20 } else { 1 };
    for target in TARGETS {
        let seeds = (target.seeds)();
        let Some(check) = target.check else {
            println!("{}: skipped, built without its feature", target.name);
            continue;
        };
        assert!(seeds.len() >= 3, "{}", target.name);
        for (number, seed) in seeds.iter().enumerate() {
            let name = target.name;
            // libFuzzer would truncate a longer one.
            let bytes = seed.len();
            assert!(bytes <= target.longest, "seed {number} for {name} has {bytes} bytes");
            assert!(check(seed), "seed {number} for {name} is not valid");
            for part in 0..8 {
                check(&seed[..seed.len() * part / 8]);
            }
        }
        check_mutations(&target, check, &seeds, times);
    }
}

fn check_mutations(target: &Target, check: fn(&[u8]) -> bool, seeds: &[Vec<u8>], times: u32) {
    let inputs = times * inputs(target);
    let mut mutator = SeedMutator(XorShift64(0x9e37_79b9_7f4a_7c15));
    let started = std::time::Instant::now();
    let valid = (0..inputs).filter(|_| check(&mutator.mutate(seeds, target.longest))).count();
    println!(
        "{}: {valid} of {inputs} changed seeds are valid, in {:?}",
        target.name,
        started.elapsed()
    );
    assert!(valid > 0, "{}: nothing was checked", target.name);
}
