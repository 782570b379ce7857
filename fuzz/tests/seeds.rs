//! Seeds are sound and keep the promises of their targets, also when they are changed by chance. In
//! one test, as memory is counted for the whole program.

use gleaner_fuzz::{TARGETS, Target};

/// Inputs made from the seeds of a target: as many as take a second or two. Twenty times as many
/// with `GLEANER_LONG=1`.
fn inputs(target: &Target) -> u32 {
    match target.name {
        "bag" => 1_000,
        "calls" => 8_000,
        "drive" => 5_000,
        _ => 20_000,
    }
}

/// xorshift64: the same inputs each time.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n as u64) as usize
    }

    /// One of the seeds, with some bytes changed, moved, left out or taken from another one.
    fn changed(&mut self, seeds: &[Vec<u8>], longest: usize) -> Vec<u8> {
        let mut bytes = seeds[self.below(seeds.len())].clone();
        for _ in 0..=self.below(4) {
            let (at, to) = (self.below(bytes.len() + 1), self.below(bytes.len() + 1));
            match self.below(4) {
                0 | 1 if at < bytes.len() => bytes[at] = self.below(256) as u8,
                2 => drop(bytes.drain(at.min(to)..at.max(to))),
                _ => {
                    let other = &seeds[self.below(seeds.len())];
                    bytes.truncate(at);
                    bytes.extend(&other[self.below(other.len() + 1)..]);
                }
            }
        }
        bytes.truncate(longest);
        bytes
    }
}

#[test]
fn all_seeds_keep_all_promises_also_when_they_are_cut_off_or_changed() {
    let times = if std::env::var("GLEANER_LONG").is_ok_and(|said| said == "1") { 20 } else { 1 };
    for target in TARGETS {
        let seeds = (target.seeds)();
        let Some(check) = target.check else {
            println!("{}: skipped, since this is built without its feature", target.name);
            continue;
        };
        assert!(seeds.len() >= 3, "{}", target.name);
        for (number, seed) in seeds.iter().enumerate() {
            // libFuzzer would cut it off.
            assert!(
                seed.len() <= target.longest,
                "seed {number} for {} has {} bytes",
                target.name,
                seed.len()
            );
            assert!(check(seed), "seed {number} for {} is not sound", target.name);
            for part in 0..8 {
                check(&seed[..seed.len() * part / 8]);
            }
        }
        changed(&target, check, &seeds, times);
    }
}

fn changed(target: &Target, check: fn(&[u8]) -> bool, seeds: &[Vec<u8>], times: u32) {
    let inputs = times * inputs(target);
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let started = std::time::Instant::now();
    let sound = (0..inputs).filter(|_| check(&random.changed(seeds, target.longest))).count();
    println!(
        "{}: {sound} of {inputs} changed seeds are sound, in {:?}",
        target.name,
        started.elapsed()
    );
    assert!(sound > 0, "{}: nothing was checked", target.name);
}
