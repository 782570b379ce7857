//! A vehicle lowers the limits of a lambda: in a replay, in its journal, and when the journal is
//! verified.

use std::path::Path;

use gleaner_tests::{
    LambdaCopy, ReplayRun, TempFolder, Verification, replay_to, root, sample_drive, verify,
};

const OK: u8 = 0;
const USAGE: u8 = 2;
const DIFFERS: i32 = 4;
const FAULTED: u8 = 6;
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

/// Replays a lambda on the vehicle described by `vehicle`.
fn on(folder: &TempFolder, lambda: &Path, vehicle: &str, args: &[&str]) -> ReplayRun {
    let file = folder.write("vehicle.toml", vehicle);
    let args = [args, &["--vehicle", file.to_str().unwrap()]].concat();
    replay_to(&folder.path().join("out"), lambda, &[sample_drive()], &args)
}

/// Verifies the journal, on that vehicle if one is given.
fn again(folder: &TempFolder, lambda: &Path, vehicle: Option<&str>) -> Verification {
    let (drive, journal) = (sample_drive(), folder.path().join("journal"));
    let mut args = vec![
        "replay".as_ref(),
        lambda.as_os_str(),
        drive.as_os_str(),
        "--verify".as_ref(),
        journal.as_os_str(),
    ];
    let file = vehicle.map(|text| folder.write("another.toml", text));
    if let Some(file) = &file {
        args.extend(["--vehicle".as_ref(), file.as_os_str()]);
    }
    verify(&args)
}

#[test]
fn the_lower_limit_applies_and_is_named() {
    let (folder, lambda) = (TempFolder::new(), root().join("examples/hello/rust"));
    let run = on(&folder, &lambda, "[limits]\nfuel = 1_000\nmemory = \"1 GiB\"\n", &[]);
    let (_, message) = run.must_exit(FAULTED).first_fault().expect("a fault");
    assert!(message.contains("[limits] allows 1,000:"), "{message}");
    let stderr = &run.stderr;
    assert!(stderr.contains("fuel 10000000 -> 1000") && !stderr.contains("memory"), "{stderr}");
    let run = on(&folder, &lambda, "[limits]\nfuel = 100_000_000\n", &BRAKING);
    assert!(run.must_exit(OK).stderr.is_empty(), "{}", run.stderr);
}

#[test]
fn a_mistake_in_the_file_of_a_vehicle_is_refused_with_its_line() {
    let (folder, lambda) = (TempFolder::new(), root().join("examples/hello/rust"));
    let run = on(&folder, &lambda, "[limits]\nfule = 1_000\n", &[]);
    let stderr = &run.must_exit(USAGE).stderr;
    assert!(
        stderr.contains("vehicle.toml, line 2: unknown key `fule`") && stderr.contains("`fuel`?"),
        "{stderr}"
    );
}

#[test]
fn a_journal_is_verified_under_the_limits_that_it_records() {
    let (folder, lambda) = (TempFolder::new(), root().join("examples/hello/rust"));
    let journal = folder.path().join("journal");
    let strict = "[limits]\nfuel = 100_000\n";
    on(
        &folder,
        &lambda,
        strict,
        &[&BRAKING[..], &["--journal", journal.to_str().unwrap()]].concat(),
    )
    .must_exit(OK);
    for vehicle in [None, Some(strict)] {
        let again = again(&folder, &lambda, vehicle);
        assert!(again.verified.is_some(), "{}", again.stderr);
    }
    let other = again(&folder, &lambda, Some("[limits]\nfuel = 200_000\n"));
    assert_eq!(other.exit, DIFFERS, "{}", other.stderr);
    for part in ["limit `fuel`", "in the journal: 100000", "now:            200000", "--vehicle"] {
        assert!(other.stderr.contains(part), "{part}: {}", other.stderr);
    }
    // The limits of a journal cannot exceed those of the manifest.
    let poor = LambdaCopy::of("examples/hello/rust", |manifest| {
        manifest.replace("fuel = 10_000_000", "fuel = 50_000")
    });
    let poor = again(&folder, poor.path(), None);
    let stderr = &poor.stderr;
    assert!(poor.exit == DIFFERS && stderr.contains("now:            50000"), "{stderr}");
}

#[test]
fn both_kinds_drop_log_lines_and_refuse_triggers_at_the_same_limits() {
    for kind in ["rust", "python"] {
        let (folder, lambda) =
            (TempFolder::new(), root().join("tests/lambdas/misbehave").join(kind));
        let summary = |vehicle: &str, behaviour: &str| {
            let behaviour = format!("behaviour={behaviour}");
            on(&folder, &lambda, vehicle, &["--set", &behaviour]).summary.expect("a summary")
        };
        let all = summary("", "log_flood");
        let few = summary("[limits]\nlog_lines = 10\n", "log_flood");
        assert_eq!(
            (few.log_lines * 10, few.log_dropped),
            (all.log_lines, all.log_dropped + all.log_lines - few.log_lines)
        );
        let all = summary("", "event_then_error");
        assert_eq!((all.triggers, all.triggers_refused), (all.wakes, 0), "{kind}");
        assert!(
            all.backed_off > 4000 && all.wakes < 30,
            "{kind}: {} wakes, {} backed off",
            all.wakes,
            all.backed_off
        );
        let few = summary("[limits]\nevents_per_minute = 3\n", "event_then_error");
        assert!((3..=6).contains(&few.triggers), "{kind}: {} triggers", few.triggers);
        assert_eq!(few.triggers + few.triggers_refused, few.wakes, "{kind}");
    }
}
