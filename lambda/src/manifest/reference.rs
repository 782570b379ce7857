//! Generates `docs/manifest.md`: every key of a `lambda.toml`. Meanings are the doc comments of the
//! types, forms the rules that check names, and numbers the bounds that check values, so that
//! nothing is written twice or outdated.

use std::fmt::{Display, Write};
use std::ops::RangeInclusive;
use std::str::FromStr;
use std::time::Duration;

use super::bounds::{self, Bounds};
use super::limit::Limit;
use super::{
    ByteSize, ItemName, LambdaName, Limits, NameError, RelativePath, Sha256, TopicName, TypeName,
    Version, format_duration,
};
use gleaner_base::grouped;

/// The files that define the types of a manifest.
const SOURCES: [&str; 2] = [include_str!("types.rs"), include_str!("config.rs")];

const BEGIN: &str = r##"# The manifest

`lambda.toml` declares when a lambda wakes, which topics it reads, what its clips contain, what it may use,
and its settings. It is in the lambda's folder. Only `[lambda]` and `[schedule]` are required.

```toml
[lambda]
name = "brake-dark"
version = "0.1.0"
kind = "wasm"                   # a component, written in Rust; or "python"
entry = "brake_dark.wasm"       # or "main.py"
description = "hard braking in the dark"

[schedule]
event = "camera"                # samples of this input wake the lambda; or period = "100ms"
backlog = "latest"              # only the newest sample; or "each", in order

[[input]]                       # one table for each topic
name = "camera"
topic = "/camera/front/compressed"
type = "sensor_msgs/msg/CompressedImage"
max_size = "2 MiB"              # largest message

[[input]]
name = "imu"
topic = "/imu/data"
type = "sensor_msgs/msg/Imu"
depth = 512                     # newest samples that the lambda can read

[record]                        # without this table, no clips
topics = ["/camera/front/compressed", "/imu/data", "/vehicle/speed"]    # inputs or not
preroll = "5s"                  # from 5 s before a trigger
postroll = "5s"                 # until 5 s after it

[limits]                        # without this table, the defaults
memory = "32 MiB"

[demand]                        # without this table, a vehicle assumes and measures
rate_hz = 30                    # wakes a second
fuel = 2_000_000                # of a wake; or cpu = "2ms"

[config]                        # settings that the code reads, and `--set` changes
brake_mps2 = { default = -3.0, unit = "m/s^2", description = "mean forward acceleration below this is braking" }
dark_luma = { default = 50.0, min = 0, max = 255, description = "mean grey below this is dark" }
```

- A *size* is a whole number and a unit (B, KiB, MiB, GiB): `"2 MiB"`.
- A *duration* is a number and a unit (us, ms, s, min, h): `"50ms"`, `"1.5s"`.
- *Images and clouds* are inputs of `sensor_msgs/msg/Image`, `CompressedImage` and `PointCloud2`.
- An unknown key is refused with its line and the nearest known key, a number out of range with the range
  ([errors.md](errors.md)). The effects of a limit are in [limits.md](limits.md).

<!-- `cargo xtask bless` writes this page from the types in `lambda/src/manifest`. -->
"##;

pub(super) struct Section {
    /// Header of the table, such as `[lambda]`.
    pub(super) title: &'static str,
    note: String,
    pub(super) keys: Vec<Key>,
}

pub(super) struct Key {
    pub(super) name: &'static str,
    form: String,
    default: String,
    range: String,
    meaning: String,
}

impl Key {
    /// Creates the key `name`, which is `field` of the type `type_name`.
    fn new(name: &'static str, type_name: &str, field: &str, form: impl Into<String>) -> Key {
        let meaning = meaning(type_name, field)
            .unwrap_or_else(|| panic!("`{field}` of `{type_name}` has a comment"));
        Key { name, form: form.into(), default: "none".to_owned(), range: String::new(), meaning }
    }

    fn needed(self) -> Key {
        self.default("*required*")
    }

    fn default(mut self, default: &str) -> Key {
        default.clone_into(&mut self.default);
        self
    }

    fn within<T: Copy>(mut self, range: RangeInclusive<T>, show: impl Fn(T) -> String) -> Key {
        self.range = format!("{} to {}", show(*range.start()), show(*range.end()));
        self
    }

    fn bounded<T: Copy>(self, bounds: &Bounds<T>, show: impl Fn(T) -> String) -> Key {
        let default = show(bounds.default);
        self.default(&default).within(bounds.range(), show)
    }

    /// Adds the default for images and clouds.
    fn or_large<T: Copy + PartialEq>(
        mut self,
        large: &Bounds<T>,
        show: impl Fn(T) -> String,
    ) -> Key {
        let _ = write!(self.default, "; of images and clouds {}", show(large.default));
        self
    }
}

/// Returns all tables, in the order of the page.
pub(super) fn sections() -> Vec<Section> {
    vec![lambda(), schedule(), input(), qos(), record(), limits(), demand(), config(), model()]
}

/// Generates the page `docs/manifest.md`.
///
/// # Panics
///
/// If the field of a key has no doc comment.
pub fn reference() -> String {
    let mut page = BEGIN.to_owned();
    for section in sections() {
        let _ = write!(page, "\n## {}\n\n{}\n\n", section.title, section.note);
        page += "| key | value | default | range | meaning |\n|---|---|---|---|---|\n";
        for Key { name, form, default, range, meaning } in section.keys {
            let _ = writeln!(page, "| `{name}` | {form} | {default} | {range} | {meaning} |");
        }
    }
    page
}

fn lambda() -> Section {
    let keys = vec![
        Key::new("name", "LambdaSection", "name", rule::<LambdaName>()).needed(),
        Key::new("version", "LambdaSection", "version", rule::<Version>()).needed(),
        Key::new("kind", "LambdaSection", "kind", "`\"wasm\"`, `\"python\"`").needed(),
        Key::new("entry", "LambdaSection", "entry", rule::<RelativePath>()).needed(),
        Key::new("files", "LambdaSection", "files", "list of paths").default("empty"),
        Key::new("description", "LambdaSection", "description", "text"),
        Key::new("deterministic", "LambdaSection", "deterministic", "`true`, `false`")
            .default("`false`"),
    ];
    let note = "Identity and code. Required. [Data files](python.md#data-files) describes `files`.";
    Section { title: "[lambda]", note: note.to_owned(), keys }
}

fn schedule() -> Section {
    let keys = vec![
        Key::new("event", "ScheduleSpec", "input", "name of an input"),
        Key::new("period", "ScheduleSpec", "period", "duration").within(bounds::PERIOD, duration),
        Key::new("backlog", "ScheduleSpec", "backlog", "`\"each\"`, `\"latest\"`")
            .default("`\"each\"`; of images and clouds `\"latest\"`"),
    ];
    let note = "When the lambda runs. Required, with either `event` or `period`; \
                `backlog` goes with `event`.\n\
                With `\"each\"`, every sample wakes the lambda, in order, \
                as far back as `depth` reaches.\n\
                With `\"latest\"`, only the newest one does, \
                and the others are counted as skipped.";
    Section { title: "[schedule]", note: note.to_owned(), keys }
}

fn input() -> Section {
    let keys = vec![
        Key::new("name", "InputSpec", "name", rule::<ItemName>()).needed(),
        Key::new("topic", "InputSpec", "topic", rule::<TopicName>()).needed(),
        Key::new("type", "InputSpec", "type_name", rule::<TypeName>()).needed(),
        Key::new("depth", "InputSpec", "depth", "number")
            .bounded(&bounds::DEPTH_SMALL, number)
            .or_large(&bounds::DEPTH_LARGE, number),
        Key::new("max_size", "InputSpec", "max_size", "size")
            .bounded(&bounds::MAX_SIZE_SMALL, size)
            .or_large(&bounds::MAX_SIZE_LARGE, size),
        Key::new("decoded_size", "InputSpec", "decoded_size", "size")
            .bounded(&bounds::DECODED_SIZE, size),
        Key::new("hold", "InputSpec", "hold", "number")
            .bounded(&bounds::HOLD_SMALL, number)
            .or_large(&bounds::HOLD_LARGE, number),
        Key::new("qos", "InputSpec", "qos", "`\"auto\"`, or the table below").default("`\"auto\"`"),
    ];
    let note = format!(
        "A topic that the lambda reads; any number of them, each with its own name and topic.\n\
         Memory is allocated before the first sample, {} at most for all inputs:\n\
         (`depth` + `hold` + 1) × `max_size`, \
         and for compressed images (`hold` + 1) × `decoded_size`.\n\
         Live, all lambdas share the memory for samples: \
         `gleaner check DIR` shows how much it is.",
        bounds::INPUTS_MEMORY_MAX
    );
    Section { title: "[[input]]", note, keys }
}

fn qos() -> Section {
    let keys = vec![
        Key::new("reliability", "Qos", "reliability", "`\"reliable\"`, `\"best_effort\"`")
            .default("`\"reliable\"`"),
        Key::new("durability", "Qos", "durability", "`\"volatile\"`, `\"transient_local\"`")
            .default("`\"volatile\"`"),
        Key::new("depth", "Qos", "depth", "number").bounded(&bounds::QOS_DEPTH, number),
    ];
    let note = "`qos = { ... }` of an input requests exactly this profile for a live topic.";
    Section { title: "qos", note: note.to_owned(), keys }
}

fn record() -> Section {
    let key = |name, form: &str| Key::new(name, "RecordSpec", name, form);
    let mut preroll_size = key("preroll_size", "size").bounded(&bounds::PREROLL_SIZE_RAM, size);
    let disk = bounds::PREROLL_SIZE_DISK;
    let _ = write!(preroll_size.default, "; on disk {}", size(disk.default));
    let _ = write!(preroll_size.range, "; on disk {} to {}", size(disk.min), size(disk.max));
    let keys = vec![
        key("topics", "list of topics").needed(),
        key("preroll", "duration").bounded(&bounds::ROLL, duration),
        key("postroll", "duration").bounded(&bounds::ROLL, duration),
        key("cooldown", "duration").bounded(&bounds::COOLDOWN, duration),
        key("max_length", "duration").bounded(&bounds::MAX_LENGTH, duration),
        key("store", "`\"ram\"`, `\"disk\"`").default("`\"ram\"`"),
        preroll_size,
    ];
    let note = "The clip that a trigger cuts ([clips.md](clips.md)). \
                Without this table, there are no clips.";
    Section { title: "[record]", note: note.to_owned(), keys }
}

fn limits() -> Section {
    let key = |limit: Limit| {
        let [min, default, max] = limit.typed();
        let (form, meaning) = (limit.unit.to_owned(), limit.meaning.trim().to_owned());
        Key { name: limit.key, form, default, range: format!("{min} to {max}"), meaning }
    };
    let keys = Limits::table().into_iter().map(key).collect();
    Section {
        title: "[limits]",
        note: "What the lambda may use. A vehicle can lower each limit.".to_owned(),
        keys,
    }
}

fn demand() -> Section {
    let key = |name, form: &str| Key::new(name, "Demand", name, form);
    let keys = vec![
        key("rate_hz", "number").within(bounds::RATE_HZ, |hz| hz.to_string()),
        key("cpu", "duration").within(bounds::DEMAND_TIME, duration),
        key("fuel", "number").within(Limits::MIN.fuel..=Limits::MAX.fuel, number),
        key("model_time", "duration").within(bounds::DEMAND_TIME, duration),
    ];
    let note = "What the lambda needs in its busiest minute, on average over its wakes.\n\
                A vehicle admits it by these numbers ([a vehicle](vehicle.md#admission)); \
                they limit only [models](models.md).\n\
                Without one, the vehicle uses what it has measured, and before that an assumption.";
    Section { title: "[demand]", note: note.to_owned(), keys }
}

fn config() -> Section {
    let keys = vec![
        Key::new("default", "ConfigItem", "default", "`true`, `false`, number or text").needed(),
        Key::new("min", "ConfigItem", "min", "number"),
        Key::new("max", "ConfigItem", "max", "number"),
        Key::new("unit", "ConfigItem", "unit", "text"),
        Key::new("description", "ConfigItem", "description", "text"),
    ];
    let note = "Settings that the code reads by name and `--set` changes. \
                The author chooses the names:\n\
                `key = value`, or `key = { ... }` with these keys.";
    Section { title: "[config]", note: note.to_owned(), keys }
}

fn model() -> Section {
    let keys = vec![
        Key::new("name", "ModelSpec", "name", rule::<ItemName>()).needed(),
        Key::new("file", "ModelSpec", "file", rule::<RelativePath>()).needed(),
        Key::new("sha256", "ModelSpec", "sha256", rule::<Sha256>()).needed(),
        Key::new("layout", "ModelSpec", "layout", "text"),
        Key::new("labels", "ModelSpec", "labels", rule::<RelativePath>()),
        Key::new("providers", "ModelSpec", "providers", "list of texts").default("empty"),
        Key::new("threads", "ModelSpec", "threads", "number").bounded(&bounds::THREADS, number),
    ];
    let note = "An ONNX model that the host runs for the lambda; see [models](models.md).";
    Section { title: "[[model]]", note: note.to_owned(), keys }
}

/// Returns the rule for a type of name, from the error for an empty one.
fn rule<T: FromStr<Err = NameError>>() -> &'static str {
    "".parse::<T>().err().map_or("a name", |refused| refused.rule)
}

fn number(number: impl Display) -> String {
    grouped(number)
}

fn size(size: ByteSize) -> String {
    format!("`\"{size}\"`")
}

fn duration(duration: Duration) -> String {
    format!("`\"{}\"`", format_duration(duration))
}

/// Returns the doc comment of `field` of the struct or enum `type_name`, in one line.
fn meaning(type_name: &str, field: &str) -> Option<String> {
    let body = SOURCES.iter().find_map(|source| {
        let at = ["struct", "enum"]
            .iter()
            .find_map(|kind| source.find(&format!("pub {kind} {type_name} {{")))?;
        source[at..].split("\n}").next()
    })?;
    let mut comment = String::new();
    for line in body.lines().map(str::trim) {
        if let Some(text) = line.strip_prefix("///") {
            comment += text;
        } else if line.trim_start_matches("pub ").starts_with(&format!("{field}:"))
            && !comment.is_empty()
        {
            return Some(comment.trim().replace('|', "\\|"));
        } else if !line.starts_with("#[") {
            comment.clear();
        }
    }
    None
}
