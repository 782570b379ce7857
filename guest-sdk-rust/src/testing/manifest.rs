//! Parses the parts of `lambda.toml` that the fake host needs. `gleaner build` parses all of it,
//! and is stricter in places. Its parser, `gleaner-lambda`, would make the first `cargo test` of a
//! lambda compile 38 crates instead of 10, in 42 s of CPU time instead of 12 s.

use std::collections::{BTreeMap, BTreeSet};

use gleaner_rules::clamps::PerCall;
use gleaner_rules::names::{self, COMPRESSED_IMAGE};
use gleaner_rules::text::quoted;
use toml::Value;

use super::error::{Error, nearest};
use super::limits::LIMITS;
use super::table::{Bounds, Table};
use crate::world::{ConfigEntry, ConfigValue};

type Result<T> = std::result::Result<T, Error>;

const KIB: u64 = 1 << 10;
const MIB: u64 = 1 << 20;
const MS: u64 = 1_000_000;
const SECOND: u64 = 1_000_000_000;

/// One `[[input]]`.
#[derive(Clone, Debug)]
pub(super) struct Input {
    pub(super) name: String,
    pub(super) topic: String,
    pub(super) type_name: String,
    pub(super) depth: usize,
    pub(super) hold: usize,
    pub(super) max_size: usize,
    /// 0 unless the input has compressed images.
    pub(super) decoded_size: u64,
}

/// One `[[model]]`.
#[derive(Clone, Debug)]
pub(super) struct Model {
    pub(super) name: String,
    /// True if it has a `layout`, for `detect`.
    pub(super) has_layout: bool,
}

/// The values of `[limits]` that apply natively.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// Total bytes of the frames that the lambda creates; tensors may have as many.
    pub(super) memory: usize,
    pub(super) handles: u64,
    pub(super) frames: usize,
    pub(super) per_call: PerCall,
    pub(super) scratch: u64,
    pub(super) log_lines: u64,
    pub(super) log_bytes: u64,
    pub(super) events_per_minute: u64,
}

/// A validated manifest.
#[derive(Debug)]
pub(super) struct Manifest {
    pub(super) name: String,
    pub(super) schedule: ScheduleSpec,
    pub(super) inputs: Vec<Input>,
    pub(super) models: Vec<Model>,
    pub(super) limits: Limits,
    items: Vec<ConfigItem>,
}

/// The `[schedule]`.
#[derive(Clone, Debug)]
pub(super) enum ScheduleSpec {
    /// A wake for each sample of the input of that name.
    Event(String),
    /// A wake after each period, in nanoseconds.
    Period(i64),
}

/// One entry of `[config]`.
#[derive(Debug)]
struct ConfigItem {
    name: String,
    default: ConfigValue,
    min: Option<f64>,
    max: Option<f64>,
}

/// Parses the text of a manifest.
pub(super) fn read(text: &str) -> Result<Manifest> {
    let entries = text.parse::<toml::Table>();
    let entries = entries.map_err(|error| {
        Error::new("cannot use the manifest", format!("it is not valid TOML: {error}"), "")
    })?;
    let known = ["lambda", "schedule", "input", "model", "record", "limits", "demand", "config"];
    let root = Table::of("the file", &entries, &known)?;
    let known = ["name", "version", "kind", "entry", "description", "deterministic"];
    let lambda = Table::new(
        "[lambda]",
        root.need("lambda", "[lambda] with name, version, kind and entry")?,
        &known,
    )?;
    if lambda.choice("kind", &["wasm", "python"])? != Some("wasm") {
        return Err(lambda.refusal("is not of kind `wasm`", "a lambda in Rust has kind = \"wasm\""));
    }
    lambda.text("entry", "entry = \"brake_dark.wasm\"", |_| true)?;
    let inputs = root.list("input")?.iter().map(input).collect::<Result<Vec<_>>>()?;
    let models = root.list("model")?.iter().map(model).collect::<Result<Vec<_>>>()?;
    unique("[[input]] with the name", inputs.iter().map(|input| &input.name))?;
    unique("[[input]] with the topic", inputs.iter().map(|input| &input.topic))?;
    unique("[[model]] with the name", models.iter().map(|model| &model.name))?;
    if let Some(value) = root.get("record") {
        let known =
            ["topics", "preroll", "postroll", "store", "preroll_size", "cooldown", "max_length"];
        Table::new("[record]", value, &known)?;
    }
    Ok(Manifest {
        name: lambda.text("name", "name = \"brake-dark\"", names::is_lambda)?,
        schedule: schedule(&root, &inputs)?,
        inputs,
        models,
        limits: limits(&root)?,
        items: items(&root)?,
    })
}

fn unique<'a>(what: &str, names: impl Iterator<Item = &'a String>) -> Result<()> {
    let mut seen = BTreeSet::new();
    let mut twice = names.filter(|name| !seen.insert(*name));
    twice.next().map_or(Ok(()), |name| {
        let cause = format!("there are two {what} `{name}`");
        Err(Error::new("cannot use the manifest", cause, "keep one of them"))
    })
}

fn schedule(root: &Table, inputs: &[Input]) -> Result<ScheduleSpec> {
    let example = "[schedule] with event = \"<an input's name>\" or period = \"100ms\"";
    let table =
        Table::new("[schedule]", root.need("schedule", example)?, &["event", "period", "backlog"])?;
    let backlog = table.choice("backlog", &["each", "latest"])?;
    match (table.get("event"), table.get("period")) {
        (Some(_), None) => {
            let event = table.text("event", "event = \"<an input's name>\"", |_| true)?;
            if !inputs.iter().any(|input| input.name == event) {
                let names = quoted(inputs.iter().map(|input| input.name.as_str()));
                return Err(table.refusal(
                    &format!("names no input: `{event}`"),
                    &format!("the inputs are {names}"),
                ));
            }
            Ok(ScheduleSpec::Event(event))
        }
        (None, Some(_)) if backlog.is_none() => {
            Ok(ScheduleSpec::Period(table.duration("period", (MS, 0, 3600 * SECOND))? as i64))
        }
        (None, Some(_)) => {
            Err(table
                .refusal("has a `backlog` beside `period`", "remove it: missed ticks are counted"))
        }
        _ => Err(table.refusal(
            "needs one of `event` and `period`",
            "a lambda runs on one input or on the clock",
        )),
    }
}

fn input(value: &Value) -> Result<Input> {
    let known = ["name", "topic", "type", "depth", "max_size", "decoded_size", "hold", "qos"];
    let table = Table::new("[[input]]", value, &known)?;
    let type_name = table.text("type", "type = \"sensor_msgs/msg/Imu\"", names::is_type)?;
    let is_compressed = type_name == COMPRESSED_IMAGE;
    let (depth, hold, size) =
        if names::is_large(&type_name) { (4, 2, 8 * MIB) } else { (64, 8, 4 * KIB) };
    if table.get("decoded_size").is_some() && !is_compressed {
        return Err(table.refusal(
            &format!("has a `decoded_size`, and {type_name} is not decoded"),
            "remove it",
        ));
    }
    let decoded_size = table.size("decoded_size", (1, 8 * MIB, 256 * MIB))?;
    Ok(Input {
        name: table.text("name", "name = \"camera\"", names::is_item)?,
        topic: table.text("topic", "topic = \"/camera/front\"", names::is_topic)?,
        depth: table.integer("depth", (1, depth, 65_536))? as usize,
        hold: table.integer("hold", (1, hold, 1024))? as usize,
        max_size: table.size("max_size", (1, size, 256 * MIB))? as usize,
        decoded_size: if is_compressed { decoded_size } else { 0 },
        type_name,
    })
}

fn model(value: &Value) -> Result<Model> {
    let known = ["name", "file", "sha256", "layout", "labels", "providers", "threads"];
    let table = Table::new("[[model]]", value, &known)?;
    Ok(Model {
        name: table.text("name", "name = \"detector\"", names::is_item)?,
        has_layout: table.get("layout").is_some(),
    })
}

fn limits(root: &Table) -> Result<Limits> {
    let known: Vec<&str> = LIMITS.iter().map(|(key, ..)| *key).collect();
    let empty = Value::Table(toml::Table::new());
    let table = Table::new("[limits]", root.get("limits").unwrap_or(&empty), &known)?;
    // Limits without effect here are validated, too.
    let read = |&(key, unit, bounds): &(&'static str, &str, Bounds)| {
        let value = match unit {
            "size" => table.size(key, bounds),
            "duration" => table.duration(key, bounds),
            _ => table.integer(key, bounds),
        };
        Ok((key, value?))
    };
    let all = LIMITS.iter().map(read).collect::<Result<BTreeMap<_, _>>>()?;
    Ok(Limits {
        memory: all["memory"] as usize,
        handles: all["handles"],
        frames: all["frames"] as usize,
        per_call: PerCall { bytes: all["call_bytes"] as usize, items: all["call_items"] as usize },
        scratch: all["scratch"],
        log_lines: all["log_lines"],
        log_bytes: all["log_bytes"],
        events_per_minute: all["events_per_minute"],
    })
}

fn items(root: &Table) -> Result<Vec<ConfigItem>> {
    let Some(value) = root.get("config") else { return Ok(Vec::new()) };
    let entries = value.as_table().ok_or_else(|| {
        root.refusal("has a `config` that is not a table", "see docs/manifest.md for its keys")
    })?;
    entries.iter().map(|(name, value)| item(name, value)).collect()
}

fn item(name: &str, value: &Value) -> Result<ConfigItem> {
    let title = format!("`config.{name}`");
    let plain = toml::Table::from_iter([("default".to_owned(), value.clone())]);
    let entries = value.as_table().unwrap_or(&plain);
    let table = Table::of(&title, entries, &["default", "min", "max", "unit", "description"])?;
    let default = match table
        .need("default", "default = 1.0, or another value of the type that the lambda expects")?
    {
        Value::Boolean(value) => ConfigValue::Boolean(*value),
        Value::Integer(value) => ConfigValue::Integer(*value),
        Value::Float(value) if value.is_finite() => ConfigValue::Real(*value),
        Value::String(value) => ConfigValue::Text(value.clone()),
        _ => {
            return Err(table.refusal(
                "has a `default` of an unsupported type",
                "use a number, a text, true or false",
            ));
        }
    };
    let limit = |key: &str| match (table.get(key), &default) {
        (None, _) => Ok(None),
        (Some(Value::Integer(limit)), ConfigValue::Integer(_) | ConfigValue::Real(_)) => {
            Ok(Some(*limit as f64))
        }
        (Some(Value::Float(limit)), ConfigValue::Real(_)) if limit.is_finite() => Ok(Some(*limit)),
        _ => Err(table.refusal(
            &format!("has a `{key}` that does not fit its default"),
            "use numbers of the same type",
        )),
    };
    let item =
        ConfigItem { name: name.to_owned(), min: limit("min")?, max: limit("max")?, default };
    item.within(&item.default)?;
    Ok(item)
}

impl ConfigItem {
    fn within(&self, value: &ConfigValue) -> Result<()> {
        let number = match value {
            ConfigValue::Integer(value) => *value as f64,
            ConfigValue::Real(value) => *value,
            ConfigValue::Boolean(_) | ConfigValue::Text(_) => return Ok(()),
        };
        let refuse = |which, limit| {
            let what = format!("config value `{}` cannot be {number}", self.name);
            Err(Error::new(what, format!("its {which} is {limit}"), "use a value within the range"))
        };
        match (self.min, self.max) {
            (Some(min), _) if number < min => refuse("min", min),
            (_, Some(max)) if number > max => refuse("max", max),
            _ => Ok(()),
        }
    }

    /// Converts `given` to the type of the default; a whole number is accepted for a number.
    fn set(&self, given: &ConfigValue) -> Result<ConfigValue> {
        let value = match (&self.default, given) {
            (ConfigValue::Real(_), ConfigValue::Integer(given)) => ConfigValue::Real(*given as f64),
            (ConfigValue::Real(_), ConfigValue::Real(given)) if given.is_finite() => {
                ConfigValue::Real(*given)
            }
            (ConfigValue::Boolean(_), ConfigValue::Boolean(_))
            | (ConfigValue::Integer(_), ConfigValue::Integer(_))
            | (ConfigValue::Text(_), ConfigValue::Text(_)) => given.clone(),
            (default, _) => {
                let wanted = match default {
                    ConfigValue::Boolean(_) => "true or false",
                    ConfigValue::Integer(_) => "a whole number",
                    ConfigValue::Real(_) => "a finite number",
                    ConfigValue::Text(_) => "a text",
                };
                let given = format!("{given:?}").replacen("ConfigValue::", "", 1);
                let what = format!("config value `{}` cannot be {given}", self.name);
                return Err(Error::new(what, "", format!("use {wanted}")));
            }
        };
        self.within(&value)?;
        Ok(value)
    }
}

impl Manifest {
    /// Returns `[config]` with the values that the test sets in place of the defaults.
    pub(super) fn config(&self, set: &[(String, ConfigValue)]) -> Result<Vec<ConfigEntry>> {
        let names = || self.items.iter().map(|item| item.name.as_str());
        if let Some((key, _)) = set.iter().find(|(key, _)| names().all(|name| name != key)) {
            let many = || format!("its config values are {}", quoted(names()));
            let help =
                nearest(key, names()).map_or_else(many, |near| format!("did you mean `{near}`?"));
            return Err(Error::new(format!("the lambda has no config value `{key}`"), "", help));
        }
        let value = |item: &ConfigItem| {
            let given = set.iter().rev().find(|(key, _)| *key == item.name);
            given.map_or_else(|| Ok(item.default.clone()), |(_, given)| item.set(given))
        };
        self.items
            .iter()
            .map(|item| Ok(ConfigEntry { key: item.name.clone(), value: value(item)? }))
            .collect()
    }
}
