//! Each operation of the disk fails once, some times, or until the disk is repaired.

use std::io::ErrorKind;

use gleaner_test_support::simulated_disk::{DiskFault, SimulatedDisk, SpoolRandom};

use crate::model::StreamModel;

/// Appends and commits, until an interval without faults at the end. Returns the number of
/// operations.
fn work(fault: Option<DiskFault>) -> u64 {
    let (disk, mut model) = (SimulatedDisk::new(1), StreamModel::default());
    let mut random = SpoolRandom(2);
    disk.set_fault(fault);
    // A disk that fails at the start is repaired before the second attempt.
    let mut writer = model.open(&disk).unwrap_or_else(|| {
        disk.set_fault(None);
        model.open(&disk).expect("the disk works")
    });
    let mut refused = false;
    for number in 0..60 {
        refused |= !model.append(&mut writer, &mut random);
        if number % 5 == 4 {
            model.commit(&mut writer);
        }
    }
    let operations = disk.operations();
    disk.set_fault(None);
    assert!(model.commit(&mut writer), "the disk works again");
    assert!(model.append(&mut writer, &mut random) && model.commit(&mut writer));
    drop(writer);
    model.check(&disk);
    assert_eq!(refused, StreamModel::refusals(&disk) > 0, "each refusal is in a gap record");
    disk.power_cut();
    model.check(&disk);
    let mut writer = model.open(&disk).expect("the disk works");
    assert!(model.append(&mut writer, &mut random) && model.commit(&mut writer));
    model.check(&disk);
    operations
}

#[test]
fn a_failure_of_any_operation_loses_nothing_acknowledged_and_ends_with_the_disks_repair() {
    let operations = work(None);
    assert!(operations > 30, "{operations} operations");
    for from in 1..=operations {
        for count in [1, 2, 3, 10, u64::MAX / 2] {
            for kind in [ErrorKind::Other, ErrorKind::StorageFull] {
                let fault = DiskFault { from, count, kind };
                println!("{fault:?}");
                work(Some(fault));
            }
        }
    }
}
