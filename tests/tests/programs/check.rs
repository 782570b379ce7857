//! `gleaner check`: mistakes that it finds without samples.

use std::path::Path;
use std::process::Command;

use gleaner_protocol::{CheckReport, NeedPlace};
use gleaner_tests::{LambdaCopy, program, root};

/// Its result, or its standard error.
fn check(lambda: &Path) -> Result<CheckReport, String> {
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
        // 512 visible samples, as many spare ones, and one being written.
        assert_eq!(need("input `imu`").bytes, Some(1025 * 4096));
        let preroll = need("recorder: preroll");
        assert_eq!((preroll.bytes, preroll.preallocated), (Some(64 << 20), true));
        assert_eq!((need("clips").bytes, need("clips").place), (None, NeedPlace::Disk));
        let rings = checked
            .needs
            .iter()
            .filter(|need| need.purpose.starts_with("input") && need.preallocated)
            .filter_map(|need| need.bytes);
        assert!(checked.resident_bytes > rings.sum());
    }
}

#[test]
fn an_unknown_field_or_input_is_found_without_a_drive() {
    let renamed = LambdaCopy::of("examples/hello/python", |manifest| {
        manifest.replace("sensor_msgs/msg/Imu", "sensor_msgs/msg/Range")
    });
    let stderr = check(renamed.path()).unwrap_err();
    assert!(stderr.contains("has no field `linear_acceleration`"), "{stderr}");
    let renamed =
        LambdaCopy::of("examples/hello/rust", |manifest| manifest.replace("\"imu\"", "\"gyro\""));
    let stderr = check(renamed.path()).unwrap_err();
    assert!(stderr.contains("`imu`") && stderr.contains("gyro"), "{stderr}");
}

#[test]
fn an_unknown_type_is_a_note_and_init_is_not_run() {
    let foreign = LambdaCopy::of("examples/hello/python", |manifest| {
        manifest.replace("sensor_msgs/msg/Imu", "car_msgs/msg/Motion")
    });
    let checked = check(foreign.path()).unwrap();
    assert_eq!(checked.init_ms, None);
    assert!(checked.notes[0].contains("car_msgs/msg/Motion"), "{:?}", checked.notes);
}
