//! Seeds: the examples' manifests, and one that uses every key.

/// Keys and values of manifests.
pub const WORDS: &[&str] = &[
    "[lambda]",
    "[schedule]",
    "[[input]]",
    "[[model]]",
    "[record]",
    "[limits]",
    "[config]",
    "name",
    "version",
    "kind",
    "entry",
    "description",
    "event",
    "period",
    "backlog",
    "topic",
    "type",
    "depth",
    "max_size",
    "decoded_size",
    "hold",
    "qos",
    "file",
    "sha256",
    "layout",
    "labels",
    "providers",
    "threads",
    "topics",
    "preroll",
    "postroll",
    "store",
    "preroll_size",
    "cooldown",
    "max_length",
    "fuel",
    "deadline",
    "model_time",
    "memory",
    "default",
    "min",
    "max",
    "unit",
    "reliability",
    "durability",
    "\"reliable\"",
    "\"best_effort\"",
    "\"volatile\"",
    "\"transient_local\"",
    "\"wasm\"",
    "\"python\"",
    "\"each\"",
    "\"latest\"",
    "\"auto\"",
    "\"ram\"",
    "\"disk\"",
    "\"ultralytics\"",
    "\"rten\"",
    "sensor_msgs/msg/CompressedImage",
    "\"100ms\"",
    "\"1 MiB\"",
    "inf",
    "nan",
    "'''",
    "\"\"\"",
    "\\u001b",
    "0x",
    "1e400",
    "_",
];

const EVERY_KEY: &str = r#"
[lambda]
name = "every-key"
version = "0.1.0"
kind = "wasm"
entry = "every_key.wasm"
description = "all of it"
[schedule]
event = "camera"
backlog = "latest"
[[input]]
name = "camera"
topic = "/camera"
type = "sensor_msgs/msg/CompressedImage"
depth = 4
hold = 2
max_size = "2 MiB"
decoded_size = "6 MiB"
qos = { reliability = "reliable", durability = "volatile", depth = 10 }
[[model]]
name = "detector"
file = "models/detector.onnx"
sha256 = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
layout = "ultralytics"
labels = "models/coco.txt"
providers = ["cuda", "cpu"]
threads = 2
[record]
topics = ["/camera", "/imu"]
preroll = "5s"
postroll = "1.5s"
store = "disk"
preroll_size = "1 GiB"
cooldown = "100ms"
max_length = "1min"
[limits]
fuel = 50_000_000
deadline = "50ms"
model_time = "40ms"
memory = "64 MiB"
[config]
on = true
count = { default = 3, min = 0, max = 9, unit = "", description = "how many" }
level = { default = -0.5, min = -1.0, max = 1e300 }
word = "text"
"#;

pub fn all() -> Vec<Vec<u8>> {
    let seeds = [
        EVERY_KEY,
        &EVERY_KEY.replace("event = \"camera\"\nbacklog = \"latest\"", "period = \"100ms\""),
        include_str!("../../../examples/brake-dark/rust/lambda.toml"),
        include_str!("../../../examples/hello/python/lambda.toml"),
    ];
    seeds.map(|seed| seed.as_bytes().to_vec()).into()
}
