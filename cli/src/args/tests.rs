use super::*;

fn replay(arguments: &[&str]) -> Result<ReplayArgs, String> {
    let line = ["gleaner", "replay"].iter().chain(arguments);
    match Cli::try_parse_from(line).map_err(|error| error.to_string())?.command {
        CliCommand::Replay(args) => Ok(args),
        other => Err(format!("{other:?}")),
    }
}

#[test]
fn the_definition_of_the_command_line_is_valid() {
    use clap::CommandFactory;
    Cli::command().debug_assert();
}

#[test]
fn a_value_may_begin_with_a_minus_and_hold_an_equals_sign() {
    let args =
        replay(&["dir", "a.mcap", "--set", "brake_mps2=-1.4", "--set", "word=a=b", "b.mcap"])
            .unwrap();
    assert_eq!(args.replayed.target.set, ["brake_mps2=-1.4", "word=a=b"]);
    assert_eq!(args.replayed.drives, [PathBuf::from("a.mcap"), PathBuf::from("b.mcap")]);
}

#[test]
fn bad_arguments_are_refused_with_an_example() {
    for (arguments, message) in [
        (["dir", "a.mcap", "--set", "brake_mps2"], "write KEY=VALUE"),
        (["dir", "a.mcap", "--set", "=3"], "write KEY=VALUE"),
        (["dir", "a.mcap", "--remap", "/imu=/car"], "write FROM:=TO"),
        (["dir", "a.mcap", "--remap", "/imu:="], "write FROM:=TO"),
        (["dir", "a.mcap", "--sett", "a=b"], "--set"),
        (["dir", "a.mcap", "--from", "12:30"], "as in 12.5 or 2min"),
    ] {
        let error = replay(&arguments).unwrap_err();
        assert!(error.contains(message), "{error}");
    }
    assert!(replay(&["dir"]).unwrap_err().contains("<DRIVE>"));
}

#[test]
fn numbers_and_addresses_are_refused_with_an_example() {
    for (arguments, message) in [
        (["run", "dir", "--for", "0"], "as in 60"),
        (["run", "dir", "--for", "2s"], "as in 60"),
        (["run", "dir", "--bytes-max", "1k"], "as in 1073741824"),
        (["run", "dir", "--disk-floor", "1GiB"], "as in 1073741824"),
        (["run", "dir", "--interface", "eth0"], "as in 192.168.1.10"),
        (["topics", "--json", "--wait", "2s"], "as in 2.5"),
    ] {
        let error = Cli::try_parse_from(["gleaner"].iter().chain(&arguments)).unwrap_err();
        assert!(error.to_string().contains(message), "{error}");
    }
}

#[test]
fn a_deployment_is_for_this_machine_or_for_a_fleet() {
    let deploy = |more: &[&str]| {
        let line = ["gleaner", "deploy", "dir", "--key", "k"].iter().chain(more);
        match Cli::try_parse_from(line).map_err(|error| error.to_string())?.command {
            CliCommand::Deploy(args) => Ok(args),
            other => Err(format!("{other:?}")),
        }
    };
    let fleet = deploy(&["--fleet", "--selector", "site=berlin", "--label", "type=van"]).unwrap();
    assert!(fleet.fleet && !fleet.local);
    assert_eq!(fleet.label, ["site=berlin", "type=van"]);
    assert!(deploy(&["--local"]).unwrap().local);
    assert!(deploy(&[]).unwrap_err().contains("--local"));
    assert!(deploy(&["--local", "--fleet"]).unwrap_err().contains("cannot be used with"));
    assert!(deploy(&["--fleet", "--run-dir", "d"]).unwrap_err().contains("cannot be used with"));
}

#[test]
fn arguments_for_a_cloud_are_checked_before_any_request() {
    for (line, message) in [
        (&["users", "invite", "ada", "--role", "root"][..], "viewer, operator, deployer or admin"),
        (&["users", "invite", "ada"], "--role"),
        (&["users", "remove", "a/b"], "as in ada"),
        (&["vehicles", "revoke", "a b"], "as in car-7"),
        (&["vehicles", "enrol", "car-7"], "--to"),
        (&["status", "--on", "a/b"], "as in car-7"),
        (&["events", "--on", "car-7", "--run-dir", "d"], "cannot be used with"),
        (&["deploy", "dir", "--key", "k", "--fleet", "--on", "car-7"], "unexpected argument"),
    ] {
        let error = Cli::try_parse_from(["gleaner"].iter().chain(line)).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
    for line in [&["users", "--json"][..], &["users", "remove", "ada", "--json"]] {
        assert!(Cli::try_parse_from(["gleaner"].iter().chain(line)).is_ok(), "{line:?}");
    }
}
