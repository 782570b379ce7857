//! What the report of a replay is drawn from: what a lambda read, what its wakes cost, what a
//! camera saw when it triggered.

use std::fs;

use gleaner_lambda::signals::{Curve, Signals};
use gleaner_tests::{Folder, Run, replay_to, root, sample_drive};

const OK: u8 = 0;
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

fn signals(lambda: &str, args: &[&str]) -> (Folder, Run, Signals) {
    let folder = Folder::new();
    let run = replay_to(folder.path(), &root().join(lambda), &[sample_drive()], args);
    run.must_exit(OK);
    let text =
        fs::read_to_string(folder.path().join("signals.json")).expect("a replay leaves signals");
    let signals = serde_json::from_str(&text).expect("they are what the protocol says");
    (folder, run, signals)
}

fn curve<'a>(signals: &'a Signals, path: &str) -> &'a Curve {
    signals
        .curves
        .iter()
        .find(|curve| curve.path == path)
        .unwrap_or_else(|| panic!("no `{path}`: {signals:?}"))
}

#[test]
fn a_replay_keeps_what_was_read_and_what_it_cost() {
    for (kind, has_fuel) in [("rust", true), ("python", false)] {
        let (folder, run, signals) = signals(&format!("examples/hello/{kind}"), &BRAKING);
        let summary = run.summary.as_ref().unwrap();
        let forward = curve(&signals, "linear_acceleration.x");
        assert_eq!((forward.input.as_str(), forward.topic.as_str()), ("imu", "/imu/data"));
        assert_eq!(
            (forward.samples, forward.non_finite, forward.per_point),
            (4170, 0, 2),
            "each sample once"
        );
        assert_eq!(forward.at_ns.len(), 2085);
        assert!(
            forward.at_ns.is_sorted()
                && forward.min.iter().zip(&forward.max).all(|(min, max)| min <= max)
        );
        assert_eq!(
            (signals.run_ns.count, signals.fuel.as_ref().map(|fuel| fuel.count)),
            (4170, has_fuel.then_some(4170))
        );
        // What wakes are known to take, give or take a machine: their sum is in the summary, too.
        assert!(
            signals.run_ns.p50 > 100 && signals.run_ns.max as f64 / 1e9 <= 1.02 * summary.run_s,
            "{:?}",
            signals.run_ns
        );
        assert!(
            signals.fuel.as_ref().is_none_or(|fuel| fuel.p50 > 100 && fuel.p50 < fuel.max),
            "{:?}",
            signals.fuel
        );
        assert_eq!(
            signals.config["brake_mps2"],
            gleaner_lambda::manifest::ConfigValue::Float(-1.4)
        );
        // The lambda does not see the camera; the recorder does.
        assert_eq!(summary.triggers, 3);
        let stamps = run.decisions.iter().map(|decision| decision.at_ns).collect::<Vec<_>>();
        assert_eq!(
            signals.pictures.iter().map(|picture| picture.at_ns).collect::<Vec<_>>(),
            stamps
        );
        for picture in &signals.pictures {
            assert_eq!(picture.topic, "/camera/front/compressed");
            assert!((0..100_000_000).contains(&(picture.at_ns - picture.image_ns)), "{picture:?}");
            assert!(
                fs::read(folder.path().join(&picture.file)).unwrap().starts_with(&[0xff, 0xd8])
            );
        }
    }
}

#[test]
fn twins_leave_the_same_curves_and_so_does_each_pass() {
    let brake_dark = |kind: &str, args: &[&str]| {
        let (_, _, signals) =
            signals(&format!("examples/brake-dark/{kind}"), &[&BRAKING, args].concat());
        (signals.curves, signals.curves_omitted)
    };
    let (curves, left_out) = brake_dark("rust", &[]);
    assert_eq!((curves.len(), left_out), (2, 0), "{curves:?}");
    assert_eq!(brake_dark("python", &[]).0, curves);
    assert_eq!(brake_dark("rust", &["--repeat", "2", "--no-record"]).0, curves);
}

#[test]
fn a_lambda_that_reads_a_thousand_fields_has_curves_of_the_first() {
    let lambda = gleaner_tests::Copy::of("tests/lambdas/ticker/python", |manifest| manifest);
    lambda.replace(
        "main.py",
        "def on_tick(ctx):\n    imu = ctx.input('imu')\n    sample = imu.newest()\n    if sample is None:\n        return\n\
         \x20   for name in ('orientation', 'angular_velocity', 'linear_acceleration'):\n\
         \x20       for n in range(9):\n            sample.number(imu.field(f'{name}_covariance[{n}]'))\n\
         \x20       for axis in 'xyz':\n            sample.number(imu.field(f'{name}.{axis}'))\n\
         \x20   sample.get(imu.field('header.frame_id'))\n",
    );
    let folder = Folder::new();
    let run = replay_to(folder.path(), lambda.path(), &[sample_drive()], &[]);
    run.must_exit(OK);
    let signals: Signals =
        serde_json::from_str(&fs::read_to_string(folder.path().join("signals.json")).unwrap())
            .unwrap();
    assert_eq!(
        (signals.curves.len(), signals.curves_omitted),
        (Signals::CURVES_MAX, 5),
        "36 numbers and a text"
    );
}
