//! Compares a lambda run natively, in the fake host of the SDK, with its component in the host:
//! every decision is equal, to the last bit of its scores, and so are the log and the counts.
//! Both use the rules of `gleaner-rules`; these tests cover the code around them.

use std::path::{Path, PathBuf};

use gleaner_base::Exit;
use gleaner_sdk::Lambda;
use gleaner_sdk::data::Encoding;
use gleaner_sdk::testing::{self, AttributeValue, FaultKind, Host, Message, Run, Setting};
use gleaner_tests::drive::{IMAGE, image, one_topic};
use gleaner_tests::fake_messages::{FakeMessage, InputFields, STAMP, messages};
use gleaner_tests::{LambdaCopy, TempFolder, replay, root, sample_drive};

const IMU: InputFields = (
    "imu",
    "/imu/data",
    &[
        STAMP[0],
        STAMP[1],
        "header.frame_id",
        "linear_acceleration.x",
        "linear_acceleration.z",
        "orientation_covariance",
    ],
);
const CAMERA: InputFields = ("camera", "/camera/front/compressed", &[STAMP[0], STAMP[1], "data"]);

/// A lambda of the checkout, with the input of comparison hosts.
struct HostComparison {
    folder: PathBuf,
    drive: PathBuf,
    messages: Vec<FakeMessage>,
    set: Vec<(&'static str, Setting, String)>,
}

impl HostComparison {
    fn on_sample_drive(lambda: &str, wanted: &[InputFields]) -> Self {
        let drive = sample_drive();
        let messages = messages(&drive, wanted);
        Self { folder: root().join(lambda), drive, messages, set: Vec::new() }
    }

    fn set<T: Into<Setting> + ToString>(mut self, key: &'static str, value: T) -> Self {
        let text = format!("{key}={}", value.to_string());
        self.set.push((key, value.into(), text));
        self
    }

    /// Runs it in the fake host, from the start of the drive to its end.
    fn natively<L: Lambda>(&self, [start_ns, end_ns]: [i64; 2]) -> Result<Run<L>, testing::Error> {
        let manifest = std::fs::read_to_string(self.folder.join("lambda.toml")).unwrap();
        let mut host = Host::from_manifest(&manifest);
        for (key, value, _) in &self.set {
            host = host.set(key, value.clone());
        }
        for input in ["imu", "camera"] {
            if let Some(first) = self.messages.iter().find(|messages| messages.input == input) {
                host = host.blank(input, first.message.clone());
            }
        }
        let mut run = host.load::<L>()?;
        run.pass_to(start_ns)?;
        for FakeMessage { input, at_ns, message } in &self.messages {
            run.deliver(input, *at_ns, message.clone())?;
        }
        // A tick at the very last instant is still due.
        run.pass_to(end_ns)?;
        Ok(run)
    }

    fn hosted(&self) -> gleaner_tests::ReplayRun {
        let set = self.set.iter().flat_map(|(_, _, text)| ["--set", text.as_str()]);
        let args = ["--all", "--no-record"].into_iter().chain(set).collect::<Vec<_>>();
        replay(&self.folder, std::slice::from_ref(&self.drive), &args)
    }

    /// Compares comparison runs; returns the native one.
    fn agree<L: Lambda>(&self, unlike: &[&str]) -> Run<L> {
        let hosted = self.hosted();
        let span = hosted
            .summary
            .as_ref()
            .map(|summary| [summary.start_ns, summary.end_ns])
            .expect("a summary");
        let run = self.natively::<L>(span).unwrap();
        assert_eq!(run.decisions().len(), hosted.decisions.len(), "{}", hosted.stderr);
        for (n, (native, hosted)) in run.decisions().iter().zip(&hosted.decisions).enumerate() {
            same(native, hosted, unlike, &format!("decision {n}"));
        }
        let native_log = run.log().into_iter().map(|line| {
            let level = format!("{:?}", line.level).to_lowercase().replace("level::", "");
            (line.at_ns, level, line.message)
        });
        let text = |line: &serde_json::Value, key: &str| line[key].as_str().unwrap().to_owned();
        let logged = hosted.log.iter();
        let logged = logged.map(|line| {
            (line["at_ns"].as_i64().unwrap(), text(line, "level"), text(line, "message"))
        });
        // Standard error is a warning in the host's log, and natively in the test's output: the
        // reason of a panic.
        let is_printed = |(_, level, message): &(i64, String, String)| {
            level == "warn" && !message.starts_with("gleaner: ")
        };
        assert_eq!(
            native_log.collect::<Vec<_>>(),
            logged.filter(|line| !is_printed(line)).collect::<Vec<_>>()
        );
        let summary = hosted.summary.expect("a summary");
        assert_eq!(
            (run.log_dropped(), run.triggers_refused()),
            (summary.log_dropped, summary.triggers_refused)
        );
        assert_eq!(
            (run.backed_off(), run.missed_ticks()),
            (summary.backed_off, summary.missed_ticks)
        );
        let skipped = summary
            .topics
            .iter()
            .map(|topic| run.counts(&topic.name).unwrap().skipped)
            .sum::<u64>();
        assert_eq!(skipped, summary.skipped);
        for topic in &summary.topics {
            let counts = run.counts(&topic.name).unwrap();
            let native = (counts.received, counts.overwritten, counts.no_slot, counts.too_big);
            assert_eq!(
                native,
                (topic.received, topic.overwritten, topic.no_slot, topic.too_big),
                "{}",
                topic.name
            );
        }
        run
    }
}

/// Asserts that a decision is equal, except for the attributes in `unlike`.
#[track_caller]
fn same(
    native: &testing::Decision,
    hosted: &gleaner_lambda::Decision,
    unlike: &[&str],
    which: &str,
) {
    let cause = match native.cause {
        testing::Cause::Event => gleaner_lambda::Cause::Event,
        testing::Cause::Tick => gleaner_lambda::Cause::Tick,
    };
    let woken =
        (hosted.at_ns, hosted.cause, hosted.input.clone(), hosted.topic.clone(), hosted.seq);
    assert_eq!(
        (native.at_ns, cause, native.input.clone(), native.topic.clone(), native.seq),
        woken,
        "{which}"
    );
    assert_eq!(native.triggers.len(), hosted.triggers.len(), "{which}");
    for (native, hosted) in native.triggers.iter().zip(&hosted.triggers) {
        let kind = format!("{:?}", native.kind).to_lowercase();
        assert_eq!(
            (kind.as_str(), &native.label),
            (hosted.kind.as_str(), &hosted.label),
            "{which}"
        );
        assert_eq!(native.score.map(f64::to_bits), hosted.score.map(f64::to_bits), "{which}");
        let plain = |(key, value): &(String, AttributeValue)| {
            let value = match value {
                AttributeValue::Boolean(value) => serde_json::Value::from(*value),
                AttributeValue::Signed(value) => serde_json::Value::from(*value),
                AttributeValue::Real(value) => serde_json::Value::from(*value),
                AttributeValue::Text(value) => serde_json::Value::from(value.as_str()),
            };
            (key.clone(), value)
        };
        let is_compared = |(key, _): &(String, _)| !unlike.contains(&key.as_str());
        let native = native.attributes.iter().map(plain).filter(is_compared).collect::<Vec<_>>();
        let hosted = hosted.attributes.clone().into_iter().filter(is_compared).collect::<Vec<_>>();
        assert_eq!(native, hosted, "{which}");
    }
    match (&native.fault, &hosted.fault) {
        (None, None) => {}
        (Some(native), Some(hosted)) => {
            let kind = match native.kind {
                FaultKind::Exception => gleaner_lambda::FaultKind::Exception,
                FaultKind::Trap => gleaner_lambda::FaultKind::Trap,
                _ => gleaner_lambda::FaultKind::HostCall,
            };
            assert_eq!(
                (kind, native.used, native.allowed),
                (hosted.kind, hosted.used, hosted.allowed),
                "{which}"
            );
            // A component adds the location of the panic.
            match native.message.strip_prefix("panicked: ") {
                Some(reason) => {
                    assert!(hosted.message.ends_with(reason), "{which}: {}", hosted.message)
                }
                None => assert_eq!(native.message, hosted.message, "{which}"),
            }
        }
        (native, hosted) => panic!("{which}: {native:?} and {hosted:?}"),
    }
}

#[test]
fn hello_finds_the_brakings_of_the_sample_drive() {
    let run = HostComparison::on_sample_drive("examples/hello/rust", &[IMU])
        .set("brake_mps2", -1.4)
        .agree::<hello::Hello>(&[]);
    assert_eq!(run.triggers().count(), 3);
}

#[test]
fn brake_dark_sees_the_pixels_that_the_host_decodes() {
    let comparison = HostComparison::on_sample_drive("examples/brake-dark/rust", &[CAMERA, IMU]);
    let run = comparison
        .set("brake_mps2", -1.4)
        .set("dark_luma", 255.0)
        .agree::<brake_dark::BrakeDark>(&[]);
    assert!(run.triggers().count() > 0);
    assert!(run.triggers().all(|trigger| trigger.attribute("luma").is_some()));
}

#[test]
fn every_function_of_the_interface_returns_the_same() {
    // The id of the writer is derived from the drive by the host, and invented by the fake host,
    // which does not convert frames to tensors.
    let run = HostComparison::on_sample_drive("tests/lambdas/probe/rust", &[CAMERA, IMU])
        .agree::<probe::Probe>(&["writer", "pixels"]);
    assert_eq!(run.faults().next(), None);
    assert!(run.triggers().filter(|trigger| trigger.label == "refusals").count() > 5);
}

#[test]
fn ticks_have_equal_times_and_equal_data() {
    let run = HostComparison::on_sample_drive("tests/lambdas/ticker/rust", &[IMU])
        .agree::<ticker::Ticker>(&[]);
    assert_eq!(run.triggers().count(), 399);
}

#[test]
fn misbehaviour_has_the_same_consequences() {
    let misbehave = |behaviour| {
        let comparison = HostComparison::on_sample_drive("tests/lambdas/misbehave/rust", &[IMU])
            .set("behaviour", behaviour);
        comparison.agree::<misbehave::Misbehave>(&[])
    };
    for behaviour in
        ["error", "panic", "not_a_frame", "huge_label", "too_many_triggers", "nan_score"]
    {
        let run = misbehave(behaviour);
        assert!(run.faults().count() >= 8 && run.backed_off() > 0, "{behaviour}");
    }
    let run = misbehave("event_then_panic");
    assert_eq!(run.triggers().count(), run.faults().count());
    assert!(misbehave("hold").counts("imu").unwrap().no_slot > 0);
    assert!(misbehave("log_flood").log_dropped() > 0);
    assert_eq!(misbehave("ok").faults().next(), None);
}

#[test]
fn a_lambda_that_does_not_start_has_the_same_error_message() {
    for (behaviour, wanted) in [
        ("error_in_init", "no, not today"),
        ("panic_in_init", "no, not today"),
        ("event_in_init", "triggers belong to a wake"),
        ("bad_input", "no input `imo`; the manifest has `imu`"),
        ("bad_field", "has no field `"),
    ] {
        let comparison = HostComparison::on_sample_drive("tests/lambdas/misbehave/rust", &[IMU])
            .set("behaviour", behaviour);
        let native = comparison.natively::<misbehave::Misbehave>([0, 0]).err().unwrap().to_string();
        let hosted = comparison.hosted();
        hosted.must_exit(Exit::LambdaFaulted.code());
        for message in [&native, &hosted.stderr] {
            assert!(
                message.contains("cannot start lambda `misbehave`")
                    && message.contains("in init: "),
                "{message}"
            );
            assert!(message.contains(wanted), "{message}");
        }
    }
}

/// A drive of images, and the same messages for the fake host.
fn images(folder: &TempFolder, lambda: &Path) -> HostComparison {
    let (width, height) = (40, 30);
    let pixels =
        |n: u32| (0..width * height * 3).map(|at| (at * 7 + n * 31) as u8).collect::<Vec<_>>();
    let cdr = |n| image(width, height, "rgb8", 3 * width, &pixels(n));
    let drive = (1..=12).map(|n| (u64::from(n) * 100_000_000, cdr(n))).collect::<Vec<_>>();
    let drive =
        one_topic(folder, "/camera/front/image_raw", "sensor_msgs/msg/Image", IMAGE, &drive);
    let messages = (1..=12).map(|n| {
        let bytes = [&[0, 1, 0, 0], cdr(n).as_slice()].concat();
        let message =
            Message::image(width, height, Encoding::Rgb8, pixels(n)).cdr(bytes).stamped(0);
        FakeMessage { input: "camera", at_ns: i64::from(n) * 100_000_000, message }
    });
    HostComparison {
        folder: lambda.to_owned(),
        drive,
        messages: messages.collect(),
        set: Vec::new(),
    }
}

#[test]
fn excessive_requests_meet_the_same_limits() {
    let folder = TempFolder::new();
    for (behaviour, bytes) in [
        ("topics", 0),
        ("read_cdr", 5000),
        ("read_frame", 5000),
        ("mean_luma", 0),
        ("long_label", 2 << 20),
        ("frames", 0),
        ("ok", 0),
    ] {
        // High enough that fuel does not end these cases.
        let lambda = LambdaCopy::of("tests/lambdas/greedy/rust", |toml| {
            toml.replace("fuel = 5_000_000", "fuel = 1_000_000_000")
        });
        let comparison =
            images(&folder, lambda.path()).set("behaviour", behaviour).set("bytes", bytes);
        let run = comparison.agree::<greedy::Greedy>(&[]);
        let good = ["read_cdr", "read_frame", "mean_luma", "ok"].contains(&behaviour);
        assert_eq!(run.faults().next().is_none(), good, "{behaviour}");
    }
}
