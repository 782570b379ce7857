//! Seeds are sound and keep the promises of their targets. In one test, as memory is counted for the whole program.

use gleaner_fuzz::TARGETS;

#[test]
fn all_seeds_keep_all_promises_also_when_they_are_cut_off() {
    for target in TARGETS {
        let seeds = (target.seeds)();
        let Some(check) = target.check else {
            println!("{}: skipped, since this is built without its feature", target.name);
            continue;
        };
        assert!(seeds.len() >= 3, "{}", target.name);
        for (number, seed) in seeds.iter().enumerate() {
            // libFuzzer would cut it off.
            assert!(seed.len() <= target.longest, "seed {number} for {} has {} bytes", target.name, seed.len());
            assert!(check(seed), "seed {number} for {} is not sound", target.name);
            for part in 0..8 {
                check(&seed[..seed.len() * part / 8]);
            }
        }
    }
}
