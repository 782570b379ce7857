//! Topics in the memory that all lambdas of a run read: a hostile one disturbs no other, and clips
//! prove what each of them saw. Single attacks are in `tests/tests/attacks.rs`.

use std::path::Path;

use gleaner_tests::live::{decisions, run_all, summary};
use gleaner_tests::readers::compare_clips;
use gleaner_tests::{LambdaCopy, TempFolder, sample_drive, verify_clip};

/// IMU samples of the sample drive.
const IMU: u64 = 4170;

/// The clips in a folder of results, oldest first.
fn clips(out: &Path) -> Vec<std::path::PathBuf> {
    let list = std::fs::read_to_string(out.join("clips.jsonl")).expect("there are clips");
    let file = |line: &str| {
        let clip: gleaner_lambda::Clip = serde_json::from_str(line).expect("a clip");
        out.join(clip.file)
    };
    list.lines().map(file).collect()
}

#[test]
fn beside_garbage_on_a_control_page_others_see_each_sample_and_their_clips_prove_it() {
    let hostile = LambdaCopy::of("tests/lambdas/attack/python", |manifest| manifest);
    let honest = [
        LambdaCopy::named("examples/hello/rust", "first"),
        LambdaCopy::named("examples/hello/python", "second"),
    ];
    let out = TempFolder::new();
    let drive = sample_drive();
    let started = run_all(
        &[hostile.path(), honest[0].path(), honest[1].path()],
        out.path(),
        &[
            "--drive",
            drive.to_str().expect("the checkout has a plain path"),
            "--rate",
            "2",
            "--set",
            "attack.attack=control_garbage",
            "--set",
            "first.brake_mps2=-1.4",
            "--set",
            "second.brake_mps2=-1.4",
        ],
    );
    let finished = started.finish();
    let begun = decisions(&out.path().join("attack"));
    assert!(begun.iter().any(|it| !it.triggers.is_empty()), "no attack: {}", finished.stderr);
    compare_clips(out.path(), &[sample_drive()]);
    for (name, lambda) in [("first", &honest[0]), ("second", &honest[1])] {
        let live = summary(&out.path().join(name));
        let imu = &live.topics[0];
        assert_eq!((imu.received, imu.no_slot, live.faults), (IMU, 0, 0), "{live:?}");
        let (mut compared, mut triggers) = (0, 0);
        for clip in clips(out.path()) {
            let again = verify_clip(&clip, lambda.path());
            let verified = again.verified.unwrap_or_else(|| panic!("{name}: {}", again.stderr));
            compared += verified.wakes - verified.uncovered;
            triggers += verified.triggers - verified.uncovered_triggers;
        }
        assert!(compared > 1000 && triggers > 1, "{name}: {compared} wakes, {triggers} triggers");
    }
}
