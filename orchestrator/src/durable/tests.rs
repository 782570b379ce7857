//! Tests of copies that are damaged, and of disks that fail or lose power.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use rustix::io::Errno;

use super::lossy_disk::{DiskImage, LossyDisk, StepFault};
use super::*;
use crate::state::{Deployed, VehicleState};

/// Number of changes of the state in a life.
const CHANGES: u64 = 4;

fn file(folder: &tempfile::TempDir) -> DurableFile {
    DurableFile::new(folder.path().join("state.json"))
}

/// Returns a state whose parts all show its generation.
fn state(generation: u64) -> VehicleState {
    let deployed = Deployed {
        envelope: format!("envelope {generation} ").repeat(20),
        lambda: "lambda".parse().unwrap(),
        release: generation,
        attempt: generation,
        is_wanted: true,
        runs_fallback: false,
        is_proven: false,
        failed: None,
        history: Vec::new(),
        cloud: None,
    };
    let deployments = BTreeMap::from([("id".parse().unwrap(), deployed)]);
    VehicleState { generation, deployments, ..VehicleState::default() }
}

/// Reads what is on a disk: a state from `acknowledged` on. The next process can write its own, and
/// leaves no other file.
fn check(image: &DiskImage, acknowledged: u64) {
    let folder = tempfile::tempdir().unwrap();
    for (path, content) in image {
        fs::write(folder.path().join(path.file_name().unwrap()), content).unwrap();
    }
    let loaded = file(&folder).load::<VehicleState>().unwrap();
    let generation = loaded.value.as_ref().map_or(0, |state| state.generation);
    assert!((acknowledged..=CHANGES).contains(&generation), "{generation} of {acknowledged}");
    assert_eq!(loaded.value, (generation > 0).then(|| state(generation)), "a mix");
    file(&folder).save(&state(CHANGES + 1)).unwrap();
    assert_eq!(file(&folder).load().unwrap().value, Some(state(CHANGES + 1)));
    let names = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
    let names: BTreeSet<_> = names.collect();
    assert_eq!(names, ["state.json", "state.json.copy"].map(Into::into).into());
}

/// Changes the state again and again. Returns the number of operations, and adds what is left.
fn life(at: usize, fault: StepFault, left: &mut BTreeSet<(DiskImage, u64)>) -> usize {
    let (disk, file) = (LossyDisk::new(at, fault), DurableFile::new("/state/state.json".into()));
    let mut acknowledged = 0;
    for generation in 1..=CHANGES {
        if file.save_by(&disk, &state(generation)).is_ok() {
            acknowledged = generation;
        }
    }
    let is_over = matches!(fault, StepFault::PowerCut);
    if !is_over {
        left.insert((disk.visible(), acknowledged));
    }
    left.extend(disk.after_power_cut().into_iter().map(|image| (image, acknowledged)));
    disk.operations()
}

#[test]
fn a_state_that_was_acknowledged_survives_any_failing_operation_and_any_power_cut() {
    let mut left = BTreeSet::new();
    let operations = life(usize::MAX, StepFault::PowerCut, &mut left);
    assert_eq!(operations, 10 * CHANGES as usize, "two copies of five operations each");
    for at in 0..operations {
        for error in [Errno::NOSPC, Errno::IO] {
            life(at, StepFault::Once(error), &mut left);
            life(at, StepFault::Always(error), &mut left);
        }
        life(at, StepFault::PowerCut, &mut left);
    }
    assert!(left.len() > operations, "{}", left.len());
    left.iter().for_each(|(image, acknowledged)| check(image, *acknowledged));
}

#[test]
fn any_changed_byte_and_any_cut_of_one_copy_is_found_and_the_other_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = file(&folder);
    assert_eq!(file.load::<Vec<u32>>().unwrap(), Loaded { value: None, damage: None });
    file.save(&vec![1, 22, 333]).unwrap();
    let whole = fs::read(&file.paths[0]).unwrap();
    let [first, second] = [&file.paths[0], &file.paths[1]];
    let damaged = |at: usize| {
        let flipped = [0x20, 0xff].map(|bits| {
            let mut changed = whole.clone();
            changed[at] ^= bits;
            changed
        });
        flipped.into_iter().chain([whole[..at].to_vec()])
    };
    for (at, damaged) in (0..whole.len()).flat_map(|at| damaged(at).map(move |it| (at, it))) {
        for (path, other) in [(first, second), (second, first)] {
            fs::write(path, &damaged).unwrap();
            let loaded = file.load::<Vec<u32>>().unwrap();
            assert_eq!(loaded.value, Some(vec![1, 22, 333]), "{at}");
            let damage = loaded.damage.unwrap();
            assert!(damage.starts_with(&format!("`{}`: ", path.display())), "{damage}");
            assert_eq!(fs::read(path).unwrap(), whole, "it is written again");
            // The other one is damaged, too, or lost: never an empty state.
            for also in [Some(&damaged), None] {
                fs::write(path, &damaged).unwrap();
                match also {
                    Some(damaged) => fs::write(other, damaged).unwrap(),
                    None => fs::remove_file(other).unwrap(),
                }
                let failure = file.load::<Vec<u32>>().unwrap_err().to_string();
                for part in ["is damaged", &*path.to_string_lossy(), "cause: ", "from a backup"] {
                    assert!(failure.contains(part), "{at}: {failure}");
                }
                fs::write(other, &whole).unwrap();
            }
            fs::write(path, &whole).unwrap();
        }
    }
    for path in [first, second] {
        fs::remove_file(path).unwrap();
        assert_eq!(file.load().unwrap().value, Some(vec![1, 22, 333]), "a copy was lost");
        assert_eq!(fs::read(path).unwrap(), whole, "it is written again");
    }
}

#[test]
fn a_value_that_cannot_be_written_leaves_the_former_one() {
    let folder = tempfile::tempdir().unwrap();
    let file = file(&folder);
    file.save(&1).unwrap();
    fs::create_dir(folder.path().join("state.json.part")).unwrap();
    file.save(&2).unwrap_err();
    assert_eq!(file.load::<u32>().unwrap().value, Some(1));
}

#[test]
fn a_value_that_could_not_be_read_again_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let file = file(&folder);
    file.save(&"short").unwrap();
    let failure = file.save(&"x".repeat(16 << 20)).unwrap_err().to_string();
    assert!(failure.contains("state.json") && failure.contains("16 MiB"), "{failure}");
    assert_eq!(file.load::<String>().unwrap().value.as_deref(), Some("short"));
    assert!(!Path::new(&format!("{}.part", file.paths[0].display())).exists());
}
