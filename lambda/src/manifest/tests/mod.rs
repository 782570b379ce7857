//! Tests of the manifest. Refusals are the user's interface: each is asserted with its whole text.

use std::time::Duration;

use super::*;
use gleaner_base::{Exit, Explain};

mod bounds;
mod keys;
mod reference;
mod relations;

/// A complete example.
const BRAKE_DARK: &str = r#"[lambda]
name = "brake-dark"
version = "0.1.0"
kind = "wasm"
entry = "brake_dark.wasm"
description = "hard braking in the dark"
[schedule]
event = "camera"
backlog = "latest"
[[input]]
name = "camera"
topic = "/camera/front/compressed"
type = "sensor_msgs/msg/CompressedImage"
depth = 4
max_size = "2 MiB"
qos = "auto"
[[input]]
name = "imu"
topic = "/imu/data"
type = "sensor_msgs/msg/Imu"
depth = 512
[record]
topics = ["/camera/front/compressed", "/imu/data", "/vehicle/speed"]
preroll = "5s"
postroll = "5s"
store = "ram"
cooldown = "0s"
[limits]
fuel = 50_000_000
deadline = "50ms"
memory = "64 MiB"
[config]
brake_mps2 = { default = -3.0, unit = "m/s^2", description = "mean forward acceleration below this is braking" }
dark_luma = { default = 50.0, min = 0, max = 255, description = "mean grey below this is dark" }
"#;

/// A periodic lambda without inputs; appended text begins in line 8.
const TICKER: &str = r#"[lambda]
name = "ticker"
version = "1.2.3"
kind = "python"
entry = "main.py"
[schedule]
period = "100ms"
"#;

#[track_caller]
fn refused(text: &str, message: &str, help: &str) {
    let error = Manifest::parse(text, "lambda.toml").unwrap_err();
    assert_eq!(error.to_string(), message);
    assert_eq!(error.help().as_deref(), Some(help));
    assert_eq!(error.exit(), Exit::Usage);
}

/// Asserts that the example is refused with `line` replaced by `instead`.
#[track_caller]
fn refused_with(line: &str, instead: &str, message: &str, help: &str) {
    assert_eq!(BRAKE_DARK.lines().filter(|known| *known == line).count(), 1, "no line `{line}`");
    let text: Vec<_> =
        BRAKE_DARK.lines().map(|known| if known == line { instead } else { known }).collect();
    refused(&text.join("\n"), message, help);
}

/// Returns an `[[input]]` of IMU samples; `more` is its fifth line.
fn input(name: &str, topic: &str, more: &str) -> String {
    format!(
        "[[input]]\nname = \"{name}\"\ntopic = \"{topic}\"\n\
         type = \"sensor_msgs/msg/Imu\"\n{more}\n"
    )
}

/// Asserts that the periodic lambda is refused with more tables appended.
#[track_caller]
fn refused_below(more: &str, message: &str, help: &str) {
    refused(&format!("{TICKER}{more}"), message, help);
}

#[test]
fn the_example_is_parsed_completely() {
    let manifest = Manifest::parse(BRAKE_DARK, "lambda.toml").unwrap();
    assert_eq!(manifest.lambda.name, "brake-dark");
    assert_eq!(manifest.lambda.kind, LambdaKind::Wasm);
    let event = ScheduleSpec::Event { input: "camera".parse().unwrap(), backlog: Backlog::Latest };
    assert_eq!(manifest.schedule, event);

    let camera = manifest.event_input().unwrap();
    assert_eq!((camera.depth, camera.hold, camera.slots()), (4, 2, 7));
    assert_eq!(camera.max_size, ByteSize::mib(2));
    assert_eq!(camera.decoded_size, Some(ByteSize::mib(8)));
    assert_eq!(camera.memory(), ByteSize::mib(7 * 2 + 3 * 8));
    let imu = manifest.input("imu").unwrap();
    assert_eq!(
        (imu.depth, imu.hold, imu.max_size, imu.decoded_size),
        (512, 8, ByteSize::kib(4), None)
    );
    assert_eq!(imu.qos, Qos::Auto);
    assert_eq!(manifest.input("lidar"), None);

    let record = manifest.record.as_ref().unwrap();
    assert_eq!(record.topics.len(), 3);
    assert_eq!(
        (record.preroll, record.store, record.cooldown),
        (Duration::from_secs(5), Store::Ram, Duration::ZERO)
    );
    assert_eq!(manifest.limits.deadline, Duration::from_millis(50));
    // An integer limit of a floating-point item becomes one; the order is that of the file.
    assert_eq!(manifest.config[0].default, ConfigValue::Float(-3.0));
    assert_eq!(manifest.config[1].max, Some(ConfigValue::Float(255.0)));
}

#[test]
fn a_periodic_lambda_needs_no_input_and_every_limit_has_a_default() {
    let manifest = Manifest::parse(TICKER, "lambda.toml").unwrap();
    assert_eq!(manifest.schedule, ScheduleSpec::Periodic { period: Duration::from_millis(100) });
    assert_eq!(manifest.event_input(), None);
    assert_eq!(manifest.limits.fuel, 50_000_000);
    assert_eq!(manifest.limits.deadline, Duration::from_millis(50));
    assert_eq!(manifest.limits.memory, ByteSize::mib(64));
    assert_eq!((manifest.record, manifest.config), (None, Vec::new()));
}

#[test]
fn the_default_of_the_preroll_size_is_that_of_its_store() {
    let record = |more: &str| {
        let text = format!("{TICKER}[record]\ntopics = [\"/a\"]\n{more}");
        Manifest::parse(&text, "lambda.toml").unwrap().record.unwrap()
    };
    let plain = record("");
    assert_eq!(
        (plain.preroll_size, plain.max_length),
        (ByteSize::mib(64), Duration::from_secs(600))
    );
    assert_eq!(record("store = \"disk\"").preroll_size, ByteSize::gib(1));
    let given = record("store = \"disk\"\npreroll_size = \"256 GiB\"\nmax_length = \"1s\"");
    assert_eq!(
        (given.preroll_size, given.max_length),
        (ByteSize::gib(256), Duration::from_secs(1))
    );
    assert_eq!(
        record("preroll_size = \"1 MiB\"\nmax_length = \"1h\"").preroll_size,
        ByteSize::mib(1)
    );
}

#[test]
fn as_json_a_record_has_its_sizes_in_bytes_and_its_times_in_nanoseconds() {
    let manifest =
        Manifest::parse(&format!("{TICKER}[record]\ntopics = [\"/a\"]"), "lambda.toml").unwrap();
    assert_eq!(
        manifest.to_json()["record"].to_string(),
        concat!(
            r#"{"topics":["/a"],"preroll_ns":5000000000,"postroll_ns":5000000000,"store":"ram","#,
            r#""preroll_size":67108864,"cooldown_ns":0,"max_length_ns":600000000000}"#
        )
    );
}

#[test]
fn the_backlog_is_each_for_small_samples_and_latest_for_large_ones() {
    for (type_name, backlog, depth) in [
        ("sensor_msgs/msg/Imu", Backlog::Each, 64),
        ("sensor_msgs/msg/Image", Backlog::Latest, 4),
        ("sensor_msgs/msg/CompressedImage", Backlog::Latest, 4),
        ("sensor_msgs/msg/PointCloud2", Backlog::Latest, 4),
    ] {
        let text = TICKER.replace("period = \"100ms\"", "event = \"x\"");
        let text = format!("{text}[[input]]\nname = \"x\"\ntopic = \"/x\"\ntype = \"{type_name}\"");
        let manifest = Manifest::parse(&text, "lambda.toml").unwrap();
        assert_eq!(
            manifest.schedule,
            ScheduleSpec::Event { input: "x".parse().unwrap(), backlog },
            "{type_name}"
        );
        assert_eq!(manifest.inputs[0].depth, depth, "{type_name}");
    }
}

#[test]
fn a_fixed_qos_has_missing_keys_of_the_default_profile_of_ros() {
    let text = BRAKE_DARK.replace("qos = \"auto\"", "qos = { reliability = \"best_effort\" }");
    let manifest = Manifest::parse(&text, "lambda.toml").unwrap();
    let qos = Qos::Fixed {
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 10,
    };
    assert_eq!(manifest.inputs[0].qos, qos);
}

#[test]
fn a_model_is_parsed_with_all_its_keys() {
    let digest = "0123456789abcdef".repeat(4);
    let more = format!(
        "[[model]]\nname = \"detector\"\nfile = \"models/d.onnx\"\nsha256 = \"{digest}\"\n\
         layout = \"yolox\"\nlabels = \"coco.txt\"\n\
         providers = [\"cuda\", \"cpu\"]\nthreads = 2"
    );
    let manifest = Manifest::parse(&format!("{TICKER}{more}"), "lambda.toml").unwrap();
    let model = &manifest.models[0];
    assert_eq!(model.file.as_path(), Path::new("models/d.onnx"));
    assert_eq!((model.sha256.as_str(), model.threads), (digest.as_str(), 2));
    assert_eq!(model.labels.as_ref().map(|it| it.as_path()), Some(Path::new("coco.txt")));
    assert_eq!((model.layout.as_deref(), model.providers.len()), (Some("yolox"), 2));
}

#[test]
fn as_json_a_manifest_has_the_keys_of_the_file_and_its_defaults() {
    let text = format!(
        "{TICKER}[[input]]\nname = \"imu\"\ntopic = \"/imu\"\n\
         type = \"sensor_msgs/msg/Imu\"\n[config]\ngain = 2"
    );
    let manifest = Manifest::parse(&text, "lambda.toml").unwrap();
    assert_eq!(
        manifest.to_json().to_string(),
        concat!(
            r#"{"lambda":{"name":"ticker","version":"1.2.3","kind":"python","entry":"main.py","#,
            r#""description":null},"#,
            r#""schedule":{"period_ns":100000000},"input":[{"name":"imu","topic":"/imu","#,
            r#""type":"sensor_msgs/msg/Imu","#,
            r#""depth":64,"max_size":4096,"decoded_size":null,"hold":8,"qos":"auto"}],"#,
            r#""model":[],"record":null,"#,
            r#""limits":{"fuel":50000000,"init_fuel":1000000000,"deadline_ns":50000000,"#,
            r#""init_deadline_ns":10000000000,"model_time_ns":1000000000,"#,
            r#""memory":67108864,"tables":20000,"stack":524288,"handles":4096,"frames":256,"#,
            r#""call_bytes":1048576,"#,
            r#""call_items":65536,"scratch":0,"log_lines":100,"log_bytes":409600,"#,
            r#""events_per_minute":12000},"#,
            r#""config":[{"name":"gain","default":2,"min":null,"max":null,"unit":null,"#,
            r#""description":null}]}"#
        )
    );
}
