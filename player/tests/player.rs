//! Starts the program with invalid arguments; no test here uses a network.

use std::process::{Command, Output};

fn play(arguments: &[&str], ros_domain: &str) -> Output {
    let mut player = Command::new(env!("CARGO_BIN_EXE_gleaner-player"));
    player.args(arguments).env("ROS_DOMAIN_ID", ros_domain).env_remove("CYCLONEDDS_URI");
    player.output().expect("the player starts")
}

#[test]
fn invalid_arguments_are_refused_with_their_documented_exit_codes() {
    for (arguments, ros_domain, code, expected) in [
        (&["no-such-drive.mcap"][..], "", 2, "cannot open drive `no-such-drive.mcap`"),
        (&["--imu", "10"], "seven", 2, "ROS_DOMAIN_ID is `seven`"),
        (&["--imu", "10", "--rate", "0"], "", 2, "greater than 0"),
        (
            &["--imu", "10", "--remap", "/imu/data:=/car/imu"],
            "",
            2,
            "`/imu/data`, which is not played",
        ),
        // A documentation address (RFC 5737), which no interface has.
        (&["--imu", "10", "--interface", "203.0.113.1"], "", 5, "--interface"),
    ] {
        let output = play(arguments, ros_domain);
        let shown = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{shown}");
        assert!(shown.contains(expected), "{shown}");
        assert!(output.stdout.is_empty());
    }
}
