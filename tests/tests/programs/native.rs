//! One lambda natively, in the fake host of the SDK, and as a component in the host: every decision
//! is equal, to the last bit of its scores, and so are the log and what is counted. Both have the
//! same rules, of `gleaner-rules`; here is what lies around them.

use std::path::{Path, PathBuf};

use gleaner_base::Exit;
use gleaner_sdk::Lambda;
use gleaner_sdk::data::Encoding;
use gleaner_sdk::testing::{self, AttributeValue, FaultKind, Host, Message, Run, Setting};
use gleaner_tests::drive::{IMAGE, image, one_topic};
use gleaner_tests::given::{Given, STAMP, Wanted, messages};
use gleaner_tests::{Copy, Folder, replay, root, sample_drive};

const IMU: Wanted = (
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
const CAMERA: Wanted = ("camera", "/camera/front/compressed", &[STAMP[0], STAMP[1], "data"]);

/// A lambda of the checkout, and what both hosts are to do with it.
struct Both {
    folder: PathBuf,
    drive: PathBuf,
    given: Vec<Given>,
    set: Vec<(&'static str, Setting, String)>,
}

impl Both {
    fn on_sample_drive(lambda: &str, wanted: &[Wanted]) -> Self {
        let drive = sample_drive();
        let given = messages(&drive, wanted);
        Self { folder: root().join(lambda), drive, given, set: Vec::new() }
    }

    fn set<T: Into<Setting> + ToString>(mut self, key: &'static str, value: T) -> Self {
        let text = format!("{key}={}", value.to_string());
        self.set.push((key, value.into(), text));
        self
    }

    /// From the start of the drive to its end, which are those of all its topics.
    fn natively<L: Lambda>(&self, [start_ns, end_ns]: [i64; 2]) -> Result<Run<L>, testing::Error> {
        let manifest = std::fs::read_to_string(self.folder.join("lambda.toml")).unwrap();
        let mut host = Host::from_manifest(&manifest);
        for (key, value, _) in &self.set {
            host = host.set(key, value.clone());
        }
        for input in ["imu", "camera"] {
            if let Some(first) = self.given.iter().find(|given| given.input == input) {
                host = host.blank(input, first.message.clone());
            }
        }
        let mut run = host.load::<L>()?;
        run.pass_to(start_ns)?;
        for Given { input, at_ns, message } in &self.given {
            run.deliver(input, *at_ns, message.clone())?;
        }
        // A tick of the very last instant is still due.
        run.pass_to(end_ns)?;
        Ok(run)
    }

    fn hosted(&self) -> gleaner_tests::Run {
        let set = self.set.iter().flat_map(|(_, _, text)| ["--set", text.as_str()]);
        let args = ["--all", "--no-record"].into_iter().chain(set).collect::<Vec<_>>();
        replay(&self.folder, std::slice::from_ref(&self.drive), &args)
    }

    /// Both, compared; what happened natively.
    fn agree<L: Lambda>(&self, unlike: &[&str]) -> Run<L> {
        let hosted = self.hosted();
        let span = hosted
            .summary
            .as_ref()
            .map(|summary| [summary.start_ns, summary.end_ns])
            .expect("a summary");
        let run = self.natively::<L>(span).unwrap();
        assert_eq!(run.decisions().len(), hosted.decisions.len(), "{}", hosted.stderr);
        for (n, (ours, theirs)) in run.decisions().iter().zip(&hosted.decisions).enumerate() {
            same(ours, theirs, unlike, &format!("decision {n}"));
        }
        let said = run.log().into_iter().map(|line| {
            let level = format!("{:?}", line.level).to_lowercase();
            (line.at_ns, level, line.message)
        });
        let text = |line: &serde_json::Value, key: &str| line[key].as_str().unwrap().to_owned();
        let logged = hosted.log.iter();
        let logged = logged.map(|line| {
            (line["at_ns"].as_i64().unwrap(), text(line, "level"), text(line, "message"))
        });
        // What is written to standard error is a warning in the log, and natively in the test's
        // output: the reason of a panic.
        let is_printed = |(_, level, message): &(i64, String, String)| {
            level == "warn" && !message.starts_with("gleaner: ")
        };
        assert_eq!(
            said.collect::<Vec<_>>(),
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
            let ours = (counts.received, counts.overwritten, counts.no_slot, counts.too_big);
            assert_eq!(
                ours,
                (topic.received, topic.overwritten, topic.no_slot, topic.too_big),
                "{}",
                topic.name
            );
        }
        run
    }
}

/// Asserts that a decision is the same, but for attributes that are `unlike`.
#[track_caller]
fn same(ours: &testing::Decision, theirs: &gleaner_lambda::Decision, unlike: &[&str], which: &str) {
    let cause = match ours.cause {
        testing::Cause::Event => gleaner_lambda::Cause::Event,
        testing::Cause::Tick => gleaner_lambda::Cause::Tick,
    };
    let woken =
        (theirs.at_ns, theirs.cause, theirs.input.clone(), theirs.topic.clone(), theirs.seq);
    assert_eq!(
        (ours.at_ns, cause, ours.input.clone(), ours.topic.clone(), ours.seq),
        woken,
        "{which}"
    );
    assert_eq!(ours.triggers.len(), theirs.triggers.len(), "{which}");
    for (ours, theirs) in ours.triggers.iter().zip(&theirs.triggers) {
        let kind = format!("{:?}", ours.kind).to_lowercase();
        assert_eq!((kind.as_str(), &ours.label), (theirs.kind.as_str(), &theirs.label), "{which}");
        assert_eq!(ours.score.map(f64::to_bits), theirs.score.map(f64::to_bits), "{which}");
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
        let ours = ours.attributes.iter().map(plain).filter(is_compared).collect::<Vec<_>>();
        let theirs = theirs.attributes.clone().into_iter().filter(is_compared).collect::<Vec<_>>();
        assert_eq!(ours, theirs, "{which}");
    }
    match (&ours.fault, &theirs.fault) {
        (None, None) => {}
        (Some(ours), Some(theirs)) => {
            let kind = match ours.kind {
                FaultKind::Exception => gleaner_lambda::FaultKind::Exception,
                FaultKind::Trap => gleaner_lambda::FaultKind::Trap,
                _ => gleaner_lambda::FaultKind::HostCall,
            };
            assert_eq!(
                (kind, ours.used, ours.allowed),
                (theirs.kind, theirs.used, theirs.allowed),
                "{which}"
            );
            // A component says where it panicked.
            match ours.message.strip_prefix("panicked: ") {
                Some(reason) => {
                    assert!(theirs.message.ends_with(reason), "{which}: {}", theirs.message)
                }
                None => assert_eq!(ours.message, theirs.message, "{which}"),
            }
        }
        (ours, theirs) => panic!("{which}: {ours:?} and {theirs:?}"),
    }
}

#[test]
fn hello_finds_the_brakings_of_the_sample_drive() {
    let run = Both::on_sample_drive("examples/hello/rust", &[IMU])
        .set("brake_mps2", -1.4)
        .agree::<hello::Hello>(&[]);
    assert_eq!(run.triggers().count(), 3);
}

#[test]
fn brake_dark_sees_the_pixels_that_the_host_decodes() {
    let both = Both::on_sample_drive("examples/brake-dark/rust", &[CAMERA, IMU]);
    let run =
        both.set("brake_mps2", -1.4).set("dark_luma", 255.0).agree::<brake_dark::BrakeDark>(&[]);
    assert!(run.triggers().count() > 0);
    assert!(run.triggers().all(|trigger| trigger.attribute("luma").is_some()));
}

#[test]
fn every_function_of_the_interface_answers_alike() {
    // The writer is made up from the drive by the one, and by the other from nothing.
    let run = Both::on_sample_drive("tests/lambdas/probe/rust", &[CAMERA, IMU])
        .agree::<probe::Probe>(&["writer"]);
    assert_eq!(run.faults().next(), None);
    assert!(run.triggers().filter(|trigger| trigger.label == "refusals").count() > 5);
}

#[test]
fn ticks_come_at_the_same_times_and_see_the_same() {
    let run =
        Both::on_sample_drive("tests/lambdas/ticker/rust", &[IMU]).agree::<ticker::Ticker>(&[]);
    assert_eq!(run.triggers().count(), 399);
}

#[test]
fn misbehaviour_has_the_same_consequences() {
    let misbehave = |behaviour| {
        let both = Both::on_sample_drive("tests/lambdas/misbehave/rust", &[IMU])
            .set("behaviour", behaviour);
        both.agree::<misbehave::Misbehave>(&[])
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
fn a_lambda_that_does_not_start_says_why_in_the_same_words() {
    for (behaviour, wanted) in [
        ("error_in_init", "no, not today"),
        ("panic_in_init", "no, not today"),
        ("event_in_init", "triggers belong to a wake"),
        ("bad_input", "no input `imo`; the manifest has `imu`"),
        ("bad_field", "has no field `"),
    ] {
        let both = Both::on_sample_drive("tests/lambdas/misbehave/rust", &[IMU])
            .set("behaviour", behaviour);
        let ours = both.natively::<misbehave::Misbehave>([0, 0]).err().unwrap().to_string();
        let hosted = both.hosted();
        hosted.must_exit(Exit::LambdaFaulted.code());
        for said in [&ours, &hosted.stderr] {
            assert!(
                said.contains("cannot start lambda `misbehave`") && said.contains("in init: "),
                "{said}"
            );
            assert!(said.contains(wanted), "{said}");
        }
    }
}

/// A drive of pictures, and the same for the fake.
fn pictures(folder: &Folder, lambda: &Path) -> Both {
    let (width, height) = (40, 30);
    let pixels =
        |n: u32| (0..width * height * 3).map(|at| (at * 7 + n * 31) as u8).collect::<Vec<_>>();
    let cdr = |n| image(width, height, "rgb8", 3 * width, &pixels(n));
    let drive = (1..=12).map(|n| (u64::from(n) * 100_000_000, cdr(n))).collect::<Vec<_>>();
    let drive =
        one_topic(folder, "/camera/front/image_raw", "sensor_msgs/msg/Image", IMAGE, &drive);
    let given = (1..=12).map(|n| {
        let bytes = [&[0, 1, 0, 0], cdr(n).as_slice()].concat();
        let message =
            Message::image(width, height, Encoding::Rgb8, pixels(n)).cdr(bytes).stamped(0);
        Given { input: "camera", at_ns: i64::from(n) * 100_000_000, message }
    });
    Both { folder: lambda.to_owned(), drive, given: given.collect(), set: Vec::new() }
}

#[test]
fn greed_meets_the_same_limits() {
    let folder = Folder::new();
    for (behaviour, bytes) in [
        ("topics", 0),
        ("read_cdr", 5000),
        ("read_frame", 5000),
        ("mean_luma", 0),
        ("long_label", 2 << 20),
        ("frames", 0),
        ("ok", 0),
    ] {
        // What is written here fuel is not to end.
        let lambda = Copy::of("tests/lambdas/greedy/rust", |toml| {
            toml.replace("fuel = 5_000_000", "fuel = 1_000_000_000")
        });
        let both = pictures(&folder, lambda.path()).set("behaviour", behaviour).set("bytes", bytes);
        let run = both.agree::<greedy::Greedy>(&[]);
        let good = ["read_cdr", "read_frame", "mean_luma", "ok"].contains(&behaviour);
        assert_eq!(run.faults().next().is_none(), good, "{behaviour}");
    }
}
