//! `gleaner check`: what a lambda without samples already shows.

use std::path::Path;
use std::process::Command;

use gleaner_protocol::{Checked, Place};
use gleaner_tests::{Copy, program, root};

/// Its result, or what it said instead.
fn check(lambda: &Path) -> Result<Checked, String> {
    let mut check = Command::new(program("gleaner"));
    check
        .env("XDG_CACHE_HOME", root().join("target/test-cache"))
        .arg("check")
        .arg(lambda)
        .arg("--json");
    let output = check.output().expect("gleaner starts");
    match output.status.success() {
        true => Ok(serde_json::from_slice(&output.stdout).expect("a result")),
        false => Err(String::from_utf8_lossy(&output.stderr).into_owned()),
    }
}

#[test]
fn init_is_run_and_the_memory_of_every_input_counted_in_both_languages() {
    for kind in ["rust", "python"] {
        let checked = check(&root().join("examples/brake-dark").join(kind)).unwrap();
        assert!(checked.init_ms.is_some() && checked.notes.is_empty(), "{checked:?}");
        let need = |purpose: &str| {
            checked.needs.iter().find(|need| need.purpose.starts_with(purpose)).unwrap()
        };
        // 512 that it sees, as many to spare, 8 that it may hold, one being written, one that a
        // wake looks at; each rounded up.
        let imu = need("input `imu`").bytes.unwrap();
        assert!((1034 * 4096..1034 * 4300).contains(&imu), "{imu}");
        let preroll = need("recorder: preroll");
        assert_eq!((preroll.bytes, preroll.preallocated), (Some(64 << 20), true));
        assert_eq!((need("clips").bytes, need("clips").place), (None, Place::Disk));
        let rings = checked
            .needs
            .iter()
            .filter(|need| need.purpose.starts_with("input"))
            .filter_map(|need| need.bytes);
        assert!(checked.resident_bytes > rings.sum());
    }
}

#[test]
fn a_field_or_an_input_that_is_not_there_is_found_without_a_drive() {
    let renamed = Copy::of("examples/hello/python", |manifest| {
        manifest.replace("sensor_msgs/msg/Imu", "sensor_msgs/msg/Range")
    });
    let said = check(renamed.path()).unwrap_err();
    assert!(said.contains("has no field `linear_acceleration`"), "{said}");
    let renamed =
        Copy::of("examples/hello/rust", |manifest| manifest.replace("\"imu\"", "\"gyro\""));
    let said = check(renamed.path()).unwrap_err();
    assert!(said.contains("`imu`") && said.contains("gyro"), "{said}");
}

#[test]
fn a_type_that_nobody_here_knows_is_a_note_and_init_waits_for_it() {
    let foreign = Copy::of("examples/hello/python", |manifest| {
        manifest.replace("sensor_msgs/msg/Imu", "car_msgs/msg/Motion")
    });
    let checked = check(foreign.path()).unwrap();
    assert_eq!(checked.init_ms, None);
    assert!(checked.notes[0].contains("car_msgs/msg/Motion"), "{:?}", checked.notes);
}
