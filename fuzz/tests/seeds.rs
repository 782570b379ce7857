//! Seeds are sound and keep the promises of their targets. In one test, as memory is counted for the whole program.

use gleaner_fuzz::TARGETS;

#[test]
fn all_seeds_keep_all_promises_also_when_they_are_cut_off() {
    for target in TARGETS {
        let seeds = (target.seeds)();
        assert!(seeds.len() >= 3, "{}", target.name);
        for (number, seed) in seeds.iter().enumerate() {
            // libFuzzer would cut it off.
            assert!(seed.len() <= target.longest, "seed {number} for {} has {} bytes", target.name, seed.len());
            assert!((target.check)(seed), "seed {number} for {} is not sound", target.name);
            for part in 0..8 {
                (target.check)(&seed[..seed.len() * part / 8]);
            }
        }
    }
}
