//! Parses each key of `lambda.toml`: one function per table, one line per key.

use toml::de::DeTable;

use super::bounds;
use super::error::{InputMemory, ManifestError};
use super::read_config;
use super::read_demand;
use super::syntax;
use super::table::{Document, TomlTable};
use super::value::TomlValue;
use super::{
    Backlog, ByteSize, Durability, InputSpec, LambdaKind, LambdaSection, Limits, Manifest,
    ModelSpec, Qos, RecordSpec, RelativePath, Reliability, ScheduleSpec, Store, TopicName,
    TypeName,
};
use gleaner_base::text::{excerpt, nearest};

type Result<T> = std::result::Result<T, ManifestError>;

/// Names that Gleaner writes: into a build, beside a build, and beside one on a vehicle.
const WRITTEN: [&str; 7] =
    ["lambda.toml", "wheels", "build", "out", "live", "revision.json", "environment"];

pub(super) fn manifest(document: &Document) -> Result<Manifest> {
    let entries =
        DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let known = &["lambda", "schedule", "input", "model", "record", "limits", "demand", "config"];
    let root = TomlTable::root(document, entries.get_ref(), known)?;
    let needed = |table: &'static str, example: &'static str| {
        root.get(table).ok_or_else(|| ManifestError::MissingTable {
            file: document.file.to_owned(),
            table,
            example,
        })
    };

    let lambda = lambda(&needed("lambda", "[lambda] with name, version, kind and entry")?)?;
    let inputs = inputs(document, &root)?;
    let schedule = schedule(
        &needed("schedule", "[schedule] with event = \"<an input's name>\" or period = \"100ms\"")?,
        &inputs,
    )?;
    let models = models(document, &root)?;
    let demand = root.get("demand");
    let demand = demand.map(|value| read_demand::demand(&value, &lambda, &schedule, &models));
    Ok(Manifest {
        lambda,
        schedule,
        inputs,
        models,
        record: root.get("record").map(|value| record(document, &value)).transpose()?,
        limits: limits(root.get("limits").as_ref(), Limits::DEFAULT)?,
        demand: demand.transpose()?.unwrap_or_default(),
        config: root.get("config").map_or(Ok(Vec::new()), |value| read_config::items(&value))?,
    })
}

/// Parses `[limits]`, also of a vehicle; limits that it does not name are those of `missing`.
pub(super) fn limits(value: Option<&TomlValue>, missing: Limits) -> Result<Limits> {
    value
        .map_or(Ok(missing), |value| Limits::read(&value.table("[limits]", Limits::KEYS)?, missing))
}

fn lambda(value: &TomlValue) -> Result<LambdaSection> {
    let known = &["name", "version", "kind", "entry", "files", "description", "deterministic"];
    let table = value.table("[lambda]", known)?;
    let lambda = LambdaSection {
        name: table.need("name", "name = \"brake-dark\"")?.parse()?,
        version: table.need("version", "version = \"0.1.0\"")?.parse()?,
        kind: table
            .need("kind", "kind = \"wasm\" or kind = \"python\"")?
            .choice(&[("wasm", LambdaKind::Wasm), ("python", LambdaKind::Python)])?,
        entry: table
            .need("entry", "entry = \"brake_dark.wasm\", or entry = \"main.py\" for Python")?
            .parse()?,
        files: table.get("files").map_or(Ok(Vec::new()), |value| data_files(&value))?,
        description: table.optional_text("description")?,
        deterministic: table.flag("deterministic")?,
    };
    let (key, instead) = match lambda.kind {
        LambdaKind::Python => ("deterministic", "Python's numbers are those of the machine"),
        LambdaKind::Wasm => ("files", "put them into `src/`, and use `include_bytes!`"),
    };
    let Some(value) = table.get(key) else { return Ok(lambda) };
    let why = format!("has no meaning with kind = \"{}\"", lambda.kind.as_str());
    Err(value.misplaced(why, format!("remove it: {instead}")))
}

fn data_files(value: &TomlValue) -> Result<Vec<RelativePath>> {
    let items = value.items("an array of paths, for example [\"anchors.json\"]")?;
    items.iter().map(data_file).collect()
}

fn data_file(value: &TomlValue) -> Result<RelativePath> {
    let path: RelativePath = value.parse()?;
    let text = path.as_str();
    let (why, help) = if text.split('/').next().is_some_and(|top| WRITTEN.contains(&top)) {
        ("which Gleaner itself writes", "give the data another name")
    } else if text.split('/').any(|part| part.starts_with('.')) {
        ("which is hidden", "give it a name that does not begin with a dot")
    } else if text.contains(['*', '?']) {
        ("which is a pattern", "name each file, or their folder")
    } else {
        return Ok(path);
    };
    Err(value.misplaced(format!("names `{}`, {why}", excerpt(text)), help))
}

fn schedule(value: &TomlValue, inputs: &[InputSpec]) -> Result<ScheduleSpec> {
    let table = value.table("[schedule]", &["event", "period", "backlog"])?;
    match (table.get("event"), table.get("period")) {
        (Some(event), None) => {
            let input = event_input(&event, inputs)?;
            let default = if input.type_name.is_large() { Backlog::Latest } else { Backlog::Each };
            let backlog = table.choice(
                "backlog",
                &[("each", Backlog::Each), ("latest", Backlog::Latest)],
                default,
            )?;
            Ok(ScheduleSpec::Event { input: input.name.clone(), backlog })
        }
        (None, Some(period)) => match table.get("backlog") {
            Some(backlog) => Err(backlog.misplaced(
                "has no meaning with `period`",
                "remove it: missed ticks are counted, never queued",
            )),
            None => Ok(ScheduleSpec::Periodic { period: period.duration(&bounds::PERIOD)? }),
        },
        (Some(event), Some(period)) => {
            let (_, second) =
                if event.offset < period.offset { (event, period) } else { (period, event) };
            Err(second.misplaced(
                "conflicts with the other kind of schedule",
                "keep `event` or `period`: a lambda runs on one input or on the clock",
            ))
        }
        (None, None) => Err(value.misplaced(
            "has neither `event` nor `period`",
            "add event = \"<an input's name>\" or period = \"100ms\"",
        )),
    }
}

fn event_input<'i>(event: &TomlValue, inputs: &'i [InputSpec]) -> Result<&'i InputSpec> {
    let name = event.text()?;
    inputs.iter().find(|input| input.name == name).ok_or_else(|| {
        let names = || inputs.iter().map(|input| input.name.as_str());
        ManifestError::NoSuchInput {
            at: event.location(),
            name: excerpt(name),
            near: nearest(name, names()).map(str::to_owned),
            inputs: names().map(str::to_owned).collect(),
        }
    })
}

fn inputs(document: &Document, root: &TomlTable) -> Result<Vec<InputSpec>> {
    let known = &["name", "topic", "type", "depth", "max_size", "decoded_size", "hold", "qos"];
    let mut names = Unique::new(document, "input", "give each [[input]] a name of its own");
    let mut topics = Unique::new(document, "topic", "keep one [[input]] entry per topic");
    let mut inputs = Vec::new();
    let mut memory = Vec::new();
    for table in root.tables("input", known)? {
        let name = table.need("name", "name = \"camera\"")?;
        let topic = table.need("topic", "topic = \"/camera/front/compressed\"")?;
        let input = input(&table, &name, &topic)?;
        names.add(input.name.as_str(), &name)?;
        topics.add(input.topic.as_str(), &topic)?;
        memory.push(InputMemory {
            name: input.name.to_string(),
            line: table.line(),
            required: input.memory(),
        });
        inputs.push(input);
    }
    let total = memory.iter().fold(0, |sum: u64, input| sum.saturating_add(input.required.bytes()));
    if total > bounds::INPUTS_MEMORY_MAX.bytes() {
        let (file, total) = (document.file.to_owned(), ByteSize::new(total));
        return Err(ManifestError::TooMuchMemory { file, total, inputs: memory });
    }
    Ok(inputs)
}

fn input(table: &TomlTable, name: &TomlValue, topic: &TomlValue) -> Result<InputSpec> {
    let type_name: TypeName = table.need("type", "type = \"sensor_msgs/msg/Imu\"")?.parse()?;
    let (depth, hold, max_size) = if type_name.is_large() {
        (bounds::DEPTH_LARGE, bounds::HOLD_LARGE, bounds::MAX_SIZE_LARGE)
    } else {
        (bounds::DEPTH_SMALL, bounds::HOLD_SMALL, bounds::MAX_SIZE_SMALL)
    };
    let decoded_size = match table.get("decoded_size") {
        Some(value) if !type_name.is_compressed_image() => {
            let why = format!("has no meaning for {type_name}");
            return Err(
                value.misplaced(why, "remove it: only sensor_msgs/msg/CompressedImage is decoded")
            );
        }
        _ if type_name.is_compressed_image() => {
            Some(table.size("decoded_size", &bounds::DECODED_SIZE)?)
        }
        _ => None,
    };
    Ok(InputSpec {
        name: name.parse()?,
        topic: topic.parse()?,
        depth: count(table.integer("depth", &depth)?),
        hold: count(table.integer("hold", &hold)?),
        max_size: table.size("max_size", &max_size)?,
        decoded_size,
        qos: table.get("qos").map_or(Ok(Qos::Auto), |value| qos(&value))?,
        type_name,
    })
}

fn qos(value: &TomlValue) -> Result<Qos> {
    let wanted = "\"auto\", or a table such as { reliability = \"reliable\", \
                  durability = \"volatile\", depth = 10 }";
    if value.raw().is_str() {
        return value.choice(&[("auto", Qos::Auto)]);
    }
    if !value.raw().is_table() {
        return Err(value.wrong_type(wanted));
    }
    let table = value.table("`input.qos`", &["reliability", "durability", "depth"])?;
    Ok(Qos::Fixed {
        reliability: table.choice(
            "reliability",
            &[("reliable", Reliability::Reliable), ("best_effort", Reliability::BestEffort)],
            Reliability::Reliable,
        )?,
        durability: table.choice(
            "durability",
            &[("volatile", Durability::Volatile), ("transient_local", Durability::TransientLocal)],
            Durability::Volatile,
        )?,
        depth: count(table.integer("depth", &bounds::QOS_DEPTH)?),
    })
}

fn models(document: &Document, root: &TomlTable) -> Result<Vec<ModelSpec>> {
    let mut names = Unique::new(document, "model", "give each [[model]] a name of its own");
    let mut models = Vec::new();
    for table in root
        .tables("model", &["name", "file", "sha256", "layout", "labels", "providers", "threads"])?
    {
        let name = table.need("name", "name = \"detector\"")?;
        let model = ModelSpec {
            name: name.parse()?,
            file: table.need("file", "file = \"models/detector.onnx\"")?.parse()?,
            sha256: table
                .need("sha256", "sha256 = \"<what sha256sum prints for the file>\"")?
                .parse()?,
            layout: table.get("layout").map(|value| one_of(&value, bounds::LAYOUTS)).transpose()?,
            labels: table.get("labels").map(|value| value.parse()).transpose()?,
            providers: table.get("providers").map_or(Ok(Vec::new()), |value| providers(&value))?,
            threads: count(table.integer("threads", &bounds::THREADS)?),
        };
        names.add(model.name.as_str(), &name)?;
        models.push(model);
    }
    Ok(models)
}

fn providers(value: &TomlValue) -> Result<Vec<String>> {
    let items = value.items("an array of texts, for example [\"cuda\", \"cpu\"]")?;
    items.iter().map(|item| one_of(item, bounds::PROVIDERS)).collect()
}

fn one_of(value: &TomlValue, known: &[&'static str]) -> Result<String> {
    let choices: Vec<_> = known.iter().map(|name| (*name, *name)).collect();
    value.choice(&choices).map(str::to_owned)
}

fn record(document: &Document, value: &TomlValue) -> Result<RecordSpec> {
    let known =
        &["topics", "preroll", "postroll", "store", "preroll_size", "cooldown", "max_length"];
    let table = value.table("[record]", known)?;
    let list = table.need("topics", "topics = [\"/imu/data\"]: what a clip holds")?;
    let mut unique = Unique::new(document, "topic", "list each topic of [record] once");
    let mut topics = Vec::new();
    for item in list.items("an array of topics, for example [\"/imu/data\"]")? {
        let topic: TopicName = item.parse()?;
        unique.add(topic.as_str(), &item)?;
        topics.push(topic);
    }
    if topics.is_empty() {
        return Err(list.misplaced("is empty", "list what a clip holds, or remove [record]"));
    }
    let store = table.choice("store", &[("ram", Store::Ram), ("disk", Store::Disk)], Store::Ram)?;
    let preroll_size = match store {
        Store::Ram => bounds::PREROLL_SIZE_RAM,
        Store::Disk => bounds::PREROLL_SIZE_DISK,
    };
    Ok(RecordSpec {
        topics,
        preroll: table.duration("preroll", &bounds::ROLL)?,
        postroll: table.duration("postroll", &bounds::ROLL)?,
        store,
        preroll_size: table.size("preroll_size", &preroll_size)?,
        cooldown: table.duration("cooldown", &bounds::COOLDOWN)?,
        max_length: table.duration("max_length", &bounds::MAX_LENGTH)?,
    })
}

/// Converts a count, whose maximum in a manifest is far below 32 bits.
fn count(n: u64) -> usize {
    usize::try_from(n).unwrap_or(usize::MAX)
}

/// Names that may be listed once only.
struct Unique<'a> {
    document: &'a Document<'a>,
    what: &'static str,
    help: &'static str,
    seen: Vec<(String, usize)>,
}

impl<'a> Unique<'a> {
    fn new(document: &'a Document<'a>, what: &'static str, help: &'static str) -> Unique<'a> {
        Unique { document, what, help, seen: Vec::new() }
    }

    fn add(&mut self, name: &str, value: &TomlValue) -> Result<()> {
        if let Some((_, first)) = self.seen.iter().find(|(seen, _)| seen == name) {
            return Err(ManifestError::Twice {
                what: self.what,
                name: name.to_owned(),
                file: self.document.file.to_owned(),
                first: self.document.line(*first),
                second: value.line(),
                help: self.help,
            });
        }
        self.seen.push((name.to_owned(), value.offset));
        Ok(())
    }
}
