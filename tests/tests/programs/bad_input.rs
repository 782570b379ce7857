//! Mistakes of users and the messages about them: a message names the object, the cause and the
//! way out, and the exit code gives scripts the kind of mistake.

use gleaner_lambda::FaultKind;
use gleaner_tests::drive::{COMPRESSED, IMAGE, compressed, corrupted, image, one_topic, truncated};
use gleaner_tests::{
    LambdaCopy, ReplayRun, TempFolder, replay, replay_to, root, runtime, sample_drive,
};

const USAGE: u8 = 2;
const FAULTED: u8 = 6;
const DAMAGED: u8 = 7;

/// Replays a copy of `hello` with a changed manifest over the sample drive.
fn hello(change: impl Fn(String) -> String, args: &[&str]) -> ReplayRun {
    replay(LambdaCopy::of("examples/hello/rust", change).path(), &[sample_drive()], args)
}

fn replaced(from: &str, to: &str) -> impl Fn(String) -> String {
    move |manifest| {
        assert!(manifest.contains(from), "the manifest has no {from}");
        manifest.replace(from, to)
    }
}

/// Asserts that each of `parts` is in the message, in this order.
#[track_caller]
fn assert_message(run: &ReplayRun, parts: &[&str]) {
    let mut rest = run.stderr.as_str();
    for part in parts {
        let at = rest.find(part).unwrap_or_else(|| panic!("no `{part}` in:\n{}", run.stderr));
        rest = &rest[at + part.len()..];
    }
}

#[test]
fn a_mistake_in_the_manifest_is_named_with_its_place_and_the_way_out() {
    let cases: [(&str, &str, &[&str]); 4] = [
        (
            "depth = 512",
            "dept = 512",
            &[
                "error: ",
                "lambda.toml, line 16: unknown key `dept` in [[input]]",
                "help:  did you mean `depth`?",
            ],
        ),
        (
            "depth = 512",
            "depth = 0",
            &[
                "line 16: `input.depth` is 0, below the minimum of 1",
                "help:  give a value from 1 to 65536",
            ],
        ),
        (
            "topic = \"/imu/data\"",
            "topic = \"/imu/dta\"",
            &[
                "error: cannot start lambda `hello`",
                "cause: cannot subscribe input `imu`",
                "no topic `/imu/dta` (did you mean `/imu/data`?)",
                "/vehicle/speed",
                "help:",
                "--remap FROM:=TO",
            ],
        ),
        (
            "type = \"sensor_msgs/msg/Imu\"",
            "type = \"sensor_msgs/msg/NavSatFix\"",
            &[
                "topic `/imu/data` has type `sensor_msgs/msg/Imu`, not `sensor_msgs/msg/NavSatFix`",
                "help:",
                "type = \"sensor_msgs/msg/Imu\"",
            ],
        ),
    ];
    for (from, to, parts) in cases {
        assert_message(hello(replaced(from, to), &[]).must_exit(USAGE), parts);
    }
}

#[test]
fn a_mistake_in_the_arguments_is_named_with_what_fits() {
    let cases: [([&str; 2], &[&str]); 3] = [
        (
            ["--remap", "/imu:=/imu/data"],
            &["no input has the topic `/imu` of --remap", "`/imu/data`"],
        ),
        (
            ["--set", "brake_mps=-1.4"],
            &["lambda `hello` has no config value `brake_mps`", "brake_mps2"],
        ),
        (["--set", "brake_mps2=hard"], &["`brake_mps2`", "`hard`", "a number"]),
    ];
    for (args, parts) in cases {
        assert_message(hello(|manifest| manifest, &args).must_exit(USAGE), parts);
    }
}

#[test]
fn remap_finds_a_topic_of_another_name() {
    let run = hello(
        replaced("topic = \"/imu/data\"", "topic = \"/car/imu\""),
        &["--remap", "/car/imu:=/imu/data", "--set", "brake_mps2=-1.4"],
    );
    assert_eq!(run.must_exit(0).labels(), ["hard-brake"; 3]);
    assert_eq!(run.decisions[0].topic.as_deref(), Some("/car/imu"));
}

#[test]
fn a_truncated_drive_keeps_the_decisions_before_its_end() {
    let folder = TempFolder::new();
    let lambda = root().join("examples/hello/rust");
    let run = replay(&lambda, &[truncated(&folder, 0.5)], &["--set", "brake_mps2=-1.4"]);
    let summary = run.must_exit(DAMAGED).summary.as_ref().expect("a summary of what was read");
    assert!(summary.wakes > 1000, "{summary:?}");
    assert_eq!(run.labels().first().map(String::as_str), Some("hard-brake"));
    let damaged = summary.damaged.as_deref().expect("the damage is named");
    assert!(damaged.contains("truncated.mcap` is damaged at byte"), "{damaged}");
    assert!(damaged.contains("results up to the damage are kept"), "{damaged}");
}

#[test]
fn a_corrupt_chunk_ends_the_drive_and_is_named() {
    let folder = TempFolder::new();
    let run = replay(
        &root().join("examples/hello/rust"),
        &[corrupted(&folder)],
        &["--set", "brake_mps2=-1.4"],
    );
    let summary = run.must_exit(DAMAGED).summary.as_ref().expect("a summary of what was read");
    assert!(summary.wakes > 0 && summary.wakes < 4170, "{summary:?}");
    let damaged = summary.damaged.as_deref().expect("the damage is named");
    assert!(damaged.contains("is damaged at byte") && damaged.contains("chunk"), "{damaged}");
}

#[test]
fn a_file_that_is_not_a_drive_is_refused() {
    let folder = TempFolder::new();
    let text = folder.write("notes.mcap", "this is no drive");
    let lambda = root().join("examples/hello/rust");
    assert_message(
        replay(&lambda, &[text], &[]).must_exit(USAGE),
        &["notes.mcap` is not an MCAP file"],
    );
    let missing = folder.path().join("missing.mcap");
    assert_message(
        replay(&lambda, &[missing], &[]).must_exit(USAGE),
        &["cannot open drive", "missing.mcap", "No such file"],
    );
}

#[test]
fn a_component_of_another_world_is_refused_by_name() {
    let run = with_component("(component)");
    assert_message(
        run.must_exit(USAGE),
        &[
            "error: cannot load lambda `hello`",
            "does not fit the world `gleaner:lambda/lambda`",
            "init",
            "help:",
            "gleaner_sdk::lambda!",
        ],
    );
}

#[test]
fn an_import_that_the_host_does_not_provide_is_named() {
    let run = with_component(
        r#"(component (import "acme:radar/sweep@1.0.0" (instance))
            (import "acme:radar/scan@1.0.0" (func)))"#,
    );
    assert_message(run.must_exit(USAGE), &["does not fit the world", "acme:radar/s"]);
}

#[test]
fn a_small_component_that_grows_while_it_is_compiled_is_refused() {
    // Each component holds sixty instances of the previous one: a few kilobytes expand to thirteen
    // million instances.
    let mut text =
        "(component (component $c0 (core module $m) (core instance (instantiate $m)))".to_owned();
    for level in 1..=4 {
        let instances = format!("(instance (instantiate $c{}))", level - 1).repeat(60);
        text += &format!("(component $c{level} {instances})");
    }
    let run = with_component(&(text + "(instance (instantiate $c4)))"));
    assert_message(
        run.must_exit(USAGE),
        &["cannot compile component", "hello.wasm", "compiling takes more than 2048 MiB of memory"],
    );
}

fn with_component(text: &str) -> ReplayRun {
    let copy = LambdaCopy::of("examples/hello/rust", |manifest| manifest);
    copy.replace("hello.wasm", wat::parse_str(text).expect("the test's own component"));
    replay(copy.path(), &[sample_drive()], &[])
}

#[test]
fn a_lambda_that_is_not_built_names_the_command() {
    let folder = TempFolder::new();
    folder.write(
        "lambda.toml",
        std::fs::read(root().join("examples/hello/rust/lambda.toml")).unwrap(),
    );
    let run = replay(folder.path(), &[sample_drive()], &[]);
    assert_message(run.must_exit(USAGE), &["help:", "gleaner build"]);
}

#[test]
fn results_inside_the_build_are_refused_by_any_path() {
    let copy = LambdaCopy::of("examples/hello/rust", |manifest| manifest);
    std::os::unix::fs::symlink(copy.path().join("build"), copy.path().join("link")).unwrap();
    for out in ["build", "build/out", "link/out/a"] {
        let run = replay_to(&copy.path().join(out), copy.path(), &[sample_drive()], &[]);
        assert_message(
            run.must_exit(USAGE),
            &[out, "lies in the build, and would change the lambda", "help:", "--out DIR"],
        );
    }
    assert!(!copy.path().join("build/out").exists() && !copy.path().join("build/.lock").exists());
}

#[test]
fn a_build_older_than_its_sources_names_the_source() {
    let copy = LambdaCopy::of("examples/hello/rust", |manifest| manifest);
    std::fs::create_dir_all(copy.path().join("src")).unwrap();
    let source = std::fs::File::create(copy.path().join("src/lib.rs")).unwrap();
    source.set_modified(std::time::SystemTime::now() + std::time::Duration::from_secs(60)).unwrap();
    let run = replay(copy.path(), &[sample_drive()], &[]);
    assert_message(run.must_exit(USAGE), &["src/lib.rs", "help:", "gleaner build"]);
}

#[test]
fn an_unknown_field_path_fails_the_start_and_lists_the_fields() {
    for kind in ["rust", "python"] {
        let run = misbehave(kind, "bad_field");
        assert_message(
            run.must_exit(FAULTED),
            &["cannot start lambda `misbehave`", "in init: ", "has no field `w`", "x, y, z"],
        );
    }
}

#[test]
fn an_exception_in_import_fails_the_start_with_its_traceback() {
    let run = replay(&root().join("tests/lambdas/raise-in-import/python"), &[sample_drive()], &[]);
    assert_message(run.must_exit(FAULTED), &["error: cannot start lambda", "in import", "main.py"]);
}

#[test]
fn an_exception_in_init_fails_the_start_with_its_traceback() {
    let run = misbehave("python", "error_in_init");
    assert_message(
        run.must_exit(FAULTED),
        &["cannot start lambda `misbehave`", "in init", "main.py", "line"],
    );
}

#[test]
fn the_log_of_a_failed_init_is_shown() {
    let copy = LambdaCopy::of("tests/lambdas/misbehave/python", |manifest| manifest);
    let init = "def __init__(self, ctx):\n        print('no tea')\n        \
                raise RuntimeError('no, not today')";
    copy.replace(
        "main.py",
        format!("class Lambda:\n    {init}\n\n    def on_event(self, ctx, event):\n        pass\n"),
    );
    let run = replay(copy.path(), &[sample_drive()], &[]);
    assert_message(
        run.must_exit(FAULTED),
        &["log: no tea", "error: cannot start lambda `misbehave`", "no, not today"],
    );
}

#[test]
fn an_exception_or_exit_in_an_event_is_a_fault_with_its_traceback_and_does_not_end_the_replay() {
    for (behaviour, parts) in
        [("error", &["main.py", "in on_event"][..]), ("exit", &["SystemExit"])]
    {
        let run = misbehave("python", behaviour);
        let (kind, message) = run.must_exit(FAULTED).first_fault().expect("a fault");
        assert_eq!(kind, FaultKind::Exception);
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        assert_continued(&run);
    }
}

/// Asserts that every wake faulted and has its decision, with back-off between them.
#[track_caller]
fn assert_continued(run: &ReplayRun) {
    let summary = run.summary.as_ref().expect("a summary");
    assert!(run.decisions.len() > 8, "{} decisions", run.decisions.len());
    assert_eq!(
        (summary.faults, summary.wakes),
        (run.decisions.len() as u64, run.decisions.len() as u64)
    );
    assert_eq!(summary.wakes + summary.backed_off, 4170);
}

#[test]
fn twins_get_the_same_error_messages() {
    for behaviour in ["huge_label", "too_many_triggers", "not_a_frame", "nan_score"] {
        let [rust, python] = ["rust", "python"]
            .map(|kind| misbehave(kind, behaviour).first_fault().expect("a fault").1);
        let error = rust.lines().next().unwrap_or_default();
        assert!(python.contains(error), "{behaviour}: {rust:?} and {python:?}");
    }
}

fn misbehave(kind: &str, behaviour: &str) -> ReplayRun {
    let lambda = root().join("tests/lambdas/misbehave").join(kind);
    replay(&lambda, &[sample_drive()], &["--set", &format!("behaviour={behaviour}")])
}

/// Replays `pixels`, in both languages, over a drive with one raw image.
fn pixels_of(message: Vec<u8>) -> [ReplayRun; 2] {
    let folder = TempFolder::new();
    let drive = one_topic(
        &folder,
        "/camera/front/image_raw",
        "sensor_msgs/msg/Image",
        IMAGE,
        &[(1, message)],
    );
    let lambdas = ["rust", "python"].map(|kind| root().join("tests/lambdas/pixels").join(kind));
    lambdas.map(|lambda| replay(&lambda, std::slice::from_ref(&drive), &[]))
}

#[test]
fn an_image_that_contradicts_itself_is_refused_with_the_numbers_and_does_not_end_the_replay() {
    let mut cut = image(10, 10, "mono8", 10, &[0; 100]);
    cut.truncate(40);
    let cases: [(Vec<u8>, &[&str]); 5] = [
        (image(4000, 3000, "rgb8", 12000, &[0; 100]), &["4000x3000", "it has 100"]),
        (image(10, 2, "bgr8", 29, &[0; 100]), &["has a step of 29 bytes; a row needs 30"]),
        (image(0, 10, "mono8", 0, &[]), &["image size is 0x10"]),
        (image(1, 1, "rgb565", 2, &[0; 2]), &["encoding `rgb565` is not supported"]),
        (cut, &["contradicts its type `sensor_msgs/msg/Image`"]),
    ];
    for (message, parts) in cases {
        for run in pixels_of(message) {
            let (_, fault) = run.must_exit(FAULTED).first_fault().expect("a fault");
            assert!(parts.iter().all(|part| fault.contains(part)), "{fault}");
        }
    }
}

#[test]
fn a_jpeg_bomb_is_refused_before_memory_is_touched() {
    // A header of 65,500 x 65,500 pixels without data.
    let mut bomb = vec![0xFF, 0xD8, 0xFF, 0xC0, 0, 17, 8];
    bomb.extend([0xFF, 0xDC, 0xFF, 0xDC, 3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0]);
    bomb.extend([0xFF, 0xDA, 0, 12, 3, 1, 0, 2, 0, 3, 0, 0, 63, 0, 0xFF, 0xD9]);
    let folder = TempFolder::new();
    let topic = "/camera/front/image_raw";
    let drive = one_topic(
        &folder,
        topic,
        "sensor_msgs/msg/CompressedImage",
        COMPRESSED,
        &[(1, compressed(&bomb))],
    );
    for kind in ["rust", "python"] {
        let copy = LambdaCopy::of(
            &format!("tests/lambdas/pixels/{kind}"),
            replaced("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
        );
        let run = replay(copy.path(), std::slice::from_ref(&drive), &[]);
        let message = run.must_exit(FAULTED).first_fault().expect("a fault").1;
        assert!(message.contains("65500x65500") && message.contains("8 MiB"), "{message}");
        let peak = run.summary.as_ref().expect("a summary").peak_rss_bytes;
        assert!(peak < 256 << 20, "{peak} bytes of memory for a message of 60");
    }
}

#[test]
fn a_sample_larger_than_max_size_is_counted_and_reported() {
    for run in pixels_of(image(1000, 1000, "rgb8", 3000, &vec![7; 3_000_000])) {
        let summary = run.must_exit(0).summary.as_ref().expect("a summary");
        assert_eq!(
            (summary.wakes, summary.topics[0].too_big, summary.topics[0].received),
            (0, 1, 0)
        );
        assert_message(&run, &["samples dropped: larger than max_size", "camera", "1048576"]);
    }
}

#[test]
fn a_default_max_size_for_small_pictures_is_warned_of() {
    let change = replaced("max_size = \"2 MiB\"\n", "");
    let lambda = LambdaCopy::of("examples/brake-dark/rust", change);
    let run = replay(lambda.path(), &[sample_drive()], &["--no-record"]);
    assert_message(&run, &["max_size is large for the samples", "camera", "ring_mib=56"]);
}

#[test]
fn an_invalid_page_of_the_shim_is_refused() {
    let folder = TempFolder::new();
    // Not a number, a number that cannot be the page, a file that is not open.
    for number in ["", "seven", "-4", "1", "99999"] {
        let mut replay = runtime();
        replay.env("GLEANER_PULSE", number).arg("replay").arg(root().join("examples/hello/rust"));
        let output = replay
            .arg(sample_drive())
            .arg("--out")
            .arg(folder.path())
            .output()
            .expect("gleaner-runtime starts");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{number}: {stderr}");
        assert!(
            stderr.contains("cannot use the shim's page")
                && stderr.contains("cause: GLEANER_PULSE "),
            "{stderr}"
        );
    }
}
