//! Lambdas with models: what users see of models that cannot be used, of lambdas that share one,
//! and of the process that runs them if it is killed.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use gleaner_protocol::Report;
use gleaner_tests::live::{
    JsonReport, RunningProgram, decisions, descendants, run_by, signal, summary,
};
use gleaner_tests::{LambdaCopy, TempFolder, gleaner, program, replay, root, sample_drive};
use serde_json::Value;

const DETECTOR: &str = "examples/yolo-detector/rust";

/// Exit code of a run in which a process failed.
const INTERNAL: i32 = 1;
/// Exit code of a file that cannot be used.
const USAGE: i32 = 2;
/// Exit code of a lambda that faulted.
const FAULTED: i32 = 6;

/// SHA-256 of the text `no model`.
const NO_MODEL: &str = "f62c7d17e241fe5c5c0c64d2e32ab6e3bd10547a9c02977cc126acc0fe6e6554";

/// SHA-256 of [`bomb`].
const BOMB: &str = "22bb103fdde8bfe0e9c4ea5770295a6efefafe90b41ca932c9f19a82b56bd780";

/// Returns a model with a constant of 64 GiB, which rten computes when it loads the model.
fn bomb() -> Vec<u8> {
    use gleaner_test_support::onnx::{ANY, FLOAT32, INT64, constant, graph, model, node, value};
    let nodes =
        [node("ConstantOfShape", &["n"], &["y0"], &[]), node("Add", &["y0", "x"], &["y"], &[])];
    let side = (1_i64 << 17).to_le_bytes();
    let sides = constant("n", INT64, &[2], &[side, side].concat());
    let output = value("y", FLOAT32, &[ANY, ANY]);
    model(&graph(&nodes, &[sides], &[value("x", FLOAT32, &[1])], &[output]))
}

fn detector(change: impl Fn(String) -> String) -> LambdaCopy {
    LambdaCopy::changed_and_named(DETECTOR, "yolo-detector", |manifest| {
        change(manifest.replace("model_time = \"400ms\"", "model_time = \"5s\""))
    })
}

fn replayed(lambda: &LambdaCopy) -> (i32, String) {
    let run = replay(lambda.path(), &[sample_drive()], &["--to", "0.5", "--no-record"]);
    (run.exit, run.stderr)
}

#[test]
fn a_model_that_cannot_be_used_is_refused_with_its_name_the_cause_and_the_way_out() {
    let other = "0".repeat(64);
    let digest = "e8af074932d4ed7e232278e3055cefcdea3edf178874a3694ae292649fb464dd";
    let cases: [(LambdaCopy, &[&str]); 4] = [
        (detector(|it| it.replace(digest, &other)), &["models/yolox_nano.onnx", digest, &other]),
        (
            detector(|it| it.replace("layout = \"yolox\"", "layout = \"nms-free\"")),
            &["`detector` is no detector", "[1, rows, 6]", "[1, 3549, 85]"],
        ),
        (
            detector(|it| it.replace("layout =", "providers = [\"cuda\"]\nlayout =")),
            &["cuda", "onnxruntime"],
        ),
        (
            detector(|it| {
                it.replace("[[model]]\nname = \"detector\"", "[[model]]\nname = \"other\"")
            }),
            &["no model `detector`; the manifest has `other`"],
        ),
    ];
    for (lambda, causes) in cases {
        let (exit, stderr) = replayed(&lambda);
        assert_eq!(exit, FAULTED, "{stderr}");
        for cause in causes {
            assert!(stderr.to_lowercase().contains(&cause.to_lowercase()), "{cause}: {stderr}");
        }
    }
}

#[test]
fn files_that_are_no_model_and_wrong_labels_are_refused() {
    let digest = "e8af074932d4ed7e232278e3055cefcdea3edf178874a3694ae292649fb464dd";
    let lambda = detector(|it| it.replace(digest, NO_MODEL));
    lambda.replace("models/yolox_nano.onnx", "no model");
    let (exit, stderr) = replayed(&lambda);
    assert_eq!(exit, FAULTED, "{stderr}");
    assert!(stderr.contains("models/yolox_nano.onnx") && stderr.contains("ONNX"), "{stderr}");

    let lambda = detector(|it| it);
    lambda.replace("models/coco.txt", "person\nbicycle\n");
    let (exit, stderr) = replayed(&lambda);
    assert_eq!(exit, FAULTED, "{stderr}");
    assert!(stderr.contains("it has 80 classes, and its `labels` have 2 lines"), "{stderr}");

    for (labels, cause) in [(b"caf\xe9\n".to_vec(), "UTF-8"), (vec![b'x'; (1 << 20) + 1], "1 MiB")]
    {
        lambda.replace("models/coco.txt", labels);
        let (exit, stderr) = replayed(&lambda);
        assert_eq!(exit, USAGE, "{stderr}");
        let message = "cannot read `models/coco.txt`, the labels of model `detector`";
        assert!(stderr.contains(message) && stderr.contains(cause), "{stderr}");
    }
}

#[test]
fn a_model_is_checked_before_the_lambda_runs_and_its_runtime_is_shown() {
    let output = gleaner().arg("check").arg(root().join(DETECTOR)).output().unwrap();
    let stdout = String::from_utf8_lossy(&output.stdout);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    assert!(stdout.contains("model `detector`: "), "{stdout}");
    assert!(stderr.contains("model `models/yolox_nano.onnx` of yolo-detector: "), "{stderr}");
}

fn start(lambdas: &[&LambdaCopy], out: &TempFolder, args: &[&str]) -> RunningProgram {
    let drive = sample_drive();
    let lambdas: Vec<&Path> = lambdas.iter().map(|lambda| lambda.path()).collect();
    let drive = ["--drive", drive.to_str().expect("the checkout has a plain path")];
    let mut command = Command::new(program("gleaner"));
    // The trace of a process that a model has ended takes longer than all else.
    command.env("RUST_BACKTRACE", "0");
    run_by(command, &lambdas, out.path(), &[&drive, args].concat())
}

#[test]
fn twins_share_one_model_and_its_results() {
    let [rust, python] = ["rust", "python"].map(|kind| {
        LambdaCopy::changed_and_named(&format!("examples/yolo-detector/{kind}"), kind, |manifest| {
            manifest.replace("model_time = \"400ms\"", "model_time = \"5s\"")
        })
    });
    let out = TempFolder::new();
    let sets = ["--set", "rust.classes=car, truck", "--set", "python.classes=car, truck"];
    let args = [&sets[..], &["--no-record", "--for", "6"]].concat();
    let finished = start(&[&rust, &python], &out, &args).finish();
    assert!(finished.status.success(), "{}: {}", finished.status, finished.stderr);
    for name in ["rust", "python"] {
        let decisions = decisions(&out.path().join(name));
        assert!(!decisions.is_empty() && summary(&out.path().join(name)).faults == 0, "{name}");
        assert!(decisions.iter().all(|it| it.model_ns > 0 && it.model_ns <= it.run_ns));
    }
    let reports = finished.lines.iter().filter_map(|line| serde_json::from_str(line).ok());
    let mut ended = reports.filter(|it: &Value| it["inference"] == "ended");
    let ended = ended.next_back().expect("its status");
    let models = ended["models"].as_array().expect("its models");
    assert_eq!(models.len(), 1, "{ended}");
    // Both were woken by the same frames, unless a busy machine skipped some.
    assert!(models[0]["shared"].as_u64() > Some(0), "{ended}");
}

#[test]
fn a_run_beyond_model_time_fails_with_the_way_out() {
    let lambda = LambdaCopy::changed_and_named(DETECTOR, "yolo-detector", |manifest| {
        manifest.replace("model_time = \"400ms\"", "model_time = \"1ms\"")
    });
    let out = TempFolder::new();
    let finished = start(&[&lambda], &out, &["--no-record", "--for", "4"]).finish();
    assert_eq!(finished.status.code(), Some(FAULTED), "{}", finished.stderr);
    let decisions = decisions(out.path());
    let faults: Vec<_> = decisions.iter().filter_map(|it| it.fault.as_ref()).collect();
    assert!(!faults.is_empty(), "{}", finished.stderr);
    for fault in faults {
        let cause = "took longer than the 1ms of `model_time`: raise it in [limits]";
        assert!(fault.message.contains(cause), "{}", fault.message);
    }
}

#[test]
fn a_load_that_kills_its_process_and_a_false_digest_harm_no_model_of_others() {
    let victim = detector(|it| it);
    let digest = "e8af074932d4ed7e232278e3055cefcdea3edf178874a3694ae292649fb464dd";
    let hostile = LambdaCopy::changed_and_named(DETECTOR, "hostile", |manifest| {
        let manifest = manifest.replace(digest, BOMB);
        manifest.replace("layout =", "providers = [\"rten\"]\nlayout =")
    });
    hostile.replace("models/yolox_nano.onnx", bomb());
    // It states the digest of the victim's model, and is started first.
    let liar = LambdaCopy::changed_and_named(DETECTOR, "liar", |it| it);
    liar.replace("models/yolox_nano.onnx", "no model");
    let out = TempFolder::new();
    let args = ["--set", "yolo-detector.classes=car, truck", "--no-record", "--all"];
    let started = start(&[&liar, &victim, &hostile], &out, &args);
    let refused = "is refused: gleaner-inference ended 3 times while it was loaded for `hostile`";
    let deadline = Instant::now() + Duration::from_secs(120);
    let mut stderr = String::new();
    while !stderr.contains(refused) {
        assert!(Instant::now() < deadline, "{stderr}");
        std::thread::sleep(Duration::from_millis(10));
        stderr += &started.stderr();
    }
    started.until_named("a decision of the other one", |_, report| match report {
        Report::Decision(it) => (it.model_ns > 0).then_some(()),
        _ => None,
    });
    started.signal("TERM");
    stderr += &started.finish().stderr;
    let refused = format!(
        "model `models/yolox_nano.onnx` of lambda `liar` is refused: the file has the SHA-256 \
         {NO_MODEL}, and the manifest states {digest}"
    );
    assert!(stderr.contains(&refused), "{stderr}");
    let restarts = |line: &&str| line.contains("gleaner-inference") && line.contains("restarting");
    assert_eq!(stderr.lines().find(restarts), None);
    let decisions = decisions(&out.path().join("yolo-detector"));
    let faults: Vec<_> = decisions.iter().filter_map(|it| it.fault.as_ref()).collect();
    assert!(faults.is_empty(), "{faults:?}");
}

#[test]
fn a_killed_process_of_models_is_started_again_and_no_lambda_is_lost() {
    let lambda = detector(|it| it);
    let out = TempFolder::new();
    let config = TempFolder::new();
    let vehicle = config.write("vehicle.toml", "[inference]\nmemory = \"3 GiB\"");
    let vehicle = vehicle.to_str().expect("a temporary folder has a plain path");
    let args = ["--set", "classes=car, truck", "--no-record", "--all", "--vehicle", vehicle];
    let started = start(&[&lambda], &out, &args);
    let detects = |times: u32| {
        let mut seen = 0;
        started.until("decisions with a model", |line| match line {
            JsonReport::Lambda(Report::Decision(it)) if it.fault.is_none() => {
                seen += u32::from(it.model_ns > 0);
                (seen == times).then_some(())
            }
            _ => None,
        });
    };
    let process = || descendants(started.pid(), "gleaner-inference");
    for _ in 0..2 {
        detects(3);
        let [before] = process()[..] else { panic!("{:?}", process()) };
        let command = std::fs::read(format!("/proc/{before}/cmdline")).expect("it runs");
        let command = String::from_utf8_lossy(&command);
        assert!(command.contains("--memory\0") && command.contains("3221225472"), "{command}");
        let environment = std::fs::read(format!("/proc/{before}/environ")).expect("it runs");
        assert!(String::from_utf8_lossy(&environment).contains("ORT_DISABLE_TELEMETRY=1\0"));
        signal(before, "KILL");
        let deadline = Instant::now() + Duration::from_secs(60);
        while matches!(process()[..], [] | [_]) && process().first().is_none_or(|it| *it == before)
        {
            assert!(Instant::now() < deadline, "it is not started again");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
    // More than may have been on their way at the last kill.
    detects(20);
    started.signal("TERM");
    let ended = started.finish();
    let live = summary(out.path());
    assert_eq!(live.restarts, 0, "{}", ended.stderr);
    let decisions = decisions(out.path());
    let faults: Vec<_> = decisions.iter().filter_map(|it| it.fault.as_ref()).collect();
    // No model may have run at the time of a kill.
    let exit = if faults.is_empty() { INTERNAL } else { FAULTED };
    assert_eq!(ended.status.code(), Some(exit), "{}", ended.stderr);
    for fault in faults {
        let message = &fault.message;
        assert!(message.contains("gleaner-inference"), "{message}");
    }
}
