//! Power cuts and kills at random instants of random work, on a disk that fails now and then.

use std::io::ErrorKind;

use gleaner_test_support::simulated_disk::{DiskFault, SimulatedDisk, SpoolRandom};

use crate::model::{StreamModel, times};

#[test]
fn nothing_acknowledged_is_lost_by_power_cuts_that_reorder_writes() {
    for seed in 0..times("GLEANER_SEEDS", 200) {
        // Shown if a check fails.
        println!("seed {seed}");
        lives(seed);
    }
}

fn lives(seed: u64) {
    let (disk, mut model) = (SimulatedDisk::new(!seed), StreamModel::default());
    let mut random = SpoolRandom(seed);
    for _ in 0..2 + random.below(6) {
        life(&disk, &mut model, &mut random);
        disk.set_fault(None);
        // Otherwise only the process was killed: the kernel still writes all.
        if random.below(3) > 0 {
            disk.power_cut();
        }
        model.check(&disk);
    }
}

fn life(disk: &SimulatedDisk, model: &mut StreamModel, random: &mut SpoolRandom) {
    let fault = |random: &mut SpoolRandom| {
        if random.below(4) == 0 {
            let from = disk.operations() + random.below(40);
            let kind = [ErrorKind::Other, ErrorKind::StorageFull][random.below(2) as usize];
            disk.set_fault(Some(DiskFault { from, count: 1 + random.below(20), kind }));
        }
    };
    fault(random);
    let Some(mut writer) = model.open(disk) else { return };
    for _ in 0..random.below(120) {
        match random.below(8) {
            0 => drop(model.commit(&mut writer)),
            1 if random.below(10) == 0 => fault(random),
            _ => drop(model.append(&mut writer, random)),
        }
    }
}
