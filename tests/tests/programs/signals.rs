//! The data of a replay's report: values that the lambda read, costs of its wakes, and images of a
//! camera at its triggers.

use std::fs;

use gleaner_lambda::signals::{Curve, Signals};
use gleaner_tests::{ReplayRun, TempFolder, replay_to, root, sample_drive};

const OK: u8 = 0;
const BRAKING: [&str; 2] = ["--set", "brake_mps2=-1.4"];

fn signals(lambda: &str, args: &[&str]) -> (TempFolder, ReplayRun, Signals) {
    let folder = TempFolder::new();
    let run = replay_to(folder.path(), &root().join(lambda), &[sample_drive()], args);
    run.must_exit(OK);
    let text =
        fs::read_to_string(folder.path().join("signals.json")).expect("a replay writes signals");
    let signals = serde_json::from_str(&text).expect("signals have the format of the protocol");
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
fn a_replay_keeps_the_values_that_were_read_and_the_costs() {
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
        // Plausible durations of wakes; their sum is in the summary, too.
        let run_ns = &signals.run_ns;
        assert!(run_ns.p50 > 100 && run_ns.max as f64 / 1e9 <= 1.02 * summary.run_s, "{run_ns:?}");
        let fuel = signals.fuel.as_ref();
        assert!(fuel.is_none_or(|fuel| fuel.p50 > 100 && fuel.p50 < fuel.max), "{fuel:?}");
        assert_eq!(
            signals.config["brake_mps2"],
            gleaner_lambda::manifest::ConfigValue::Float(-1.4)
        );
        // Images come from the recorder: the lambda does not read the camera.
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
fn twins_and_repeated_passes_give_the_same_curves() {
    let brake_dark = |kind: &str, args: &[&str]| {
        let (_, _, signals) =
            signals(&format!("examples/brake-dark/{kind}"), &[&BRAKING, args].concat());
        (signals.curves, signals.curves_omitted)
    };
    let (curves, omitted) = brake_dark("rust", &[]);
    assert_eq!((curves.len(), omitted), (2, 0), "{curves:?}");
    assert_eq!(brake_dark("python", &[]).0, curves);
    assert_eq!(brake_dark("rust", &["--repeat", "2", "--no-record"]).0, curves);
}

#[test]
fn a_lambda_that_reads_many_fields_has_curves_of_the_first() {
    let lambda = gleaner_tests::LambdaCopy::of("tests/lambdas/ticker/python", |manifest| manifest);
    lambda.replace(
        "main.py",
        "def on_tick(ctx):\n    imu = ctx.input('imu')\n    sample = imu.newest()\n    \
         if sample is None:\n        return\n    \
         for name in ('orientation', 'angular_velocity', 'linear_acceleration'):\n        \
         for n in range(9):\n            \
         sample.number(imu.field(f'{name}_covariance[{n}]'))\n        \
         for axis in 'xyz':\n            sample.number(imu.field(f'{name}.{axis}'))\n    \
         sample.get(imu.field('header.frame_id'))\n",
    );
    let folder = TempFolder::new();
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
