//! What a journal claims: which lambda decided what, and where that is written.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use gleaner_protocol::journal::{Difference, Entry, Header, JournalError, Reader};
use gleaner_protocol::manifest::{ConfigSet, ConfigValue, Manifest};
use gleaner_protocol::{BuildDir, Exit, Failure, visible};
use gleaner_transport::replay::read_extras;
use serde_json::Value;

use crate::input::Remap;
use crate::journal::Identity;
use crate::replay::Options;
use crate::replay::stage::DriveError;

/// Most bytes of a clip's attachments and metadata that are read: a journal part has 64 MiB at most.
const EXTRAS_BYTES: u64 = 256 << 20;

/// A journal, opened.
pub(in crate::replay) struct Claim {
    path: PathBuf,
    reader: Reader<Box<dyn Read + Send>>,
    /// Whether it is the part in a clip, which begins in the middle.
    pub(super) is_part: bool,
    /// What the clip tells people; nothing for a journal.
    pub(super) told: Told,
}

/// What a clip tells people of itself, in its metadata.
#[derive(Default)]
pub(super) struct Told {
    /// Messages of each topic.
    pub(super) messages: Vec<(String, u64)>,
    /// What is missing of each topic, in words.
    losses: Vec<String>,
    /// Triggers of the lambda.
    pub(super) triggers: u64,
    /// The first of them, in words.
    moments: Vec<String>,
}

/// As many moments as a clip keeps.
const MOMENTS_MAX: usize = 10_000;

impl Told {
    fn of(metadata: &[(String, BTreeMap<String, String>)], lambda: &str) -> Self {
        let mut told = Self::default();
        for (name, values) in metadata {
            let value = |key: &str| values.get(key).map_or("", String::as_str);
            match name.as_str() {
                "gleaner.topic" => {
                    told.messages.push((value("topic").to_owned(), value("messages").parse().unwrap_or(0)));
                    for (key, what) in [("overwritten", "pushed out"), ("too_big", "too big")] {
                        if value(key) != "0" {
                            told.losses.push(format!("{}: {} {what}", value("topic"), value(key)));
                        }
                    }
                }
                "gleaner.decision" if value("lambda") == lambda => {
                    let score = values.get("score").map_or("none", String::as_str);
                    told.moments.push(moment(value("at_ns"), value("kind"), value("label"), score));
                }
                _ => {}
            }
        }
        told
    }

    /// Adds what the journal says.
    pub(super) fn add(&mut self, entry: &Entry) {
        for trigger in &entry.triggers {
            self.triggers += 1;
            if self.moments.len() < MOMENTS_MAX {
                let score = trigger.score.map_or("none".to_owned(), |score| score.to_string());
                self.moments.push(moment(&entry.at_ns.to_string(), trigger.kind.as_str(), &trigger.label, &score));
            }
        }
    }

    /// The first trigger that the journal and the clip do not tell alike.
    pub(super) fn moments_differ(&self, clip: &Told) -> Option<Difference> {
        // The clip's limit is for all its lambdas.
        let all = clip.moments.len().max(self.moments.len().min(MOMENTS_MAX / 100));
        (0..all).find_map(|index| {
            let side = |told: &Told| told.moments.get(index).cloned().unwrap_or_else(|| "none".to_owned());
            let (journal, now) = (side(self), side(clip));
            let what = format!("trigger {} of the clip", index + 1);
            (journal != now).then_some(Difference { what, journal, now })
        })
    }

    /// What is missing in the clip, in words; none if nothing is.
    pub(super) fn losses(&self) -> Option<String> {
        (!self.losses.is_empty()).then(|| visible(&self.losses.join(", ")))
    }
}

fn moment(at_ns: &str, kind: &str, label: &str, score: &str) -> String {
    visible(&format!("{kind} `{label}` at {at_ns} ns, score {score}"))
}

impl Claim {
    /// The journal of a replay.
    pub(in crate::replay) fn journal(path: &Path) -> Result<Self, Failure> {
        let file = File::open(path).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot open journal `{}`", path.display()), &error)
        })?;
        Self::open(path, Box::new(BufReader::new(file)), false, Told::default())
    }

    /// The part of the journal of `lambda` that a clip holds.
    pub(in crate::replay) fn clip(path: &Path, lambda: &str) -> Result<Self, Failure> {
        let extras = read_extras(path, EXTRAS_BYTES).map_err(|error| Failure::from(DriveError(error)))?;
        if !extras.is_whole {
            let message = format!("clip `{}` is cut off or was never finished", path.display());
            return Err(Failure::new(Exit::Usage, message).with_help("copy it again; a clip of Gleaner has its end"));
        }
        let told = Told::of(&extras.metadata, lambda);
        let wanted = format!("journal/{lambda}.journal");
        let mut journals = extras.attachments.into_iter().filter(|attachment| attachment.name.starts_with("journal/"));
        let mut others = Vec::new();
        let part = journals.find_map(|attachment| {
            let found = attachment.name == wanted;
            others.push(attachment.name);
            found.then_some(attachment.data)
        });
        let Some(part) = part else {
            let message = format!("clip `{}` holds no journal of lambda `{lambda}`", path.display());
            let help = if others.is_empty() {
                "it was recovered after its recorder had died, or is no clip of Gleaner".to_owned()
            } else {
                format!("it holds `{}`: name that lambda with --lambda", others.join("`, `"))
            };
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        };
        Self::open(path, Box::new(Cursor::new(part)), true, told)
    }

    fn open(path: &Path, bytes: Box<dyn Read + Send>, is_part: bool, told: Told) -> Result<Self, Failure> {
        let reader = Reader::open(bytes).map_err(|error| unusable(path, &error))?;
        Ok(Self { path: path.to_owned(), reader, is_part, told })
    }

    /// A comparison of nothing proves nothing.
    pub(super) fn empty(&self) -> Failure {
        let message = format!("the journal in `{}` holds no whole wake", self.path.display());
        Failure::new(Exit::Usage, message).with_help("its writer died early, or it was cut off: write a new one")
    }

    pub(super) fn header(&self) -> &Header {
        self.reader.header()
    }

    /// The next wake; none at the end.
    pub(super) fn next(&mut self) -> Result<Option<Entry>, Failure> {
        self.reader.next().map_err(|error| unusable(&self.path, &error))
    }

    pub(super) fn reader(&self) -> &Reader<Box<dyn Read + Send>> {
        &self.reader
    }

    /// What the journal was made with, unless `set` and `remaps` say otherwise, which then has to be the same.
    pub(in crate::replay) fn options(
        &self,
        lambda: PathBuf,
        build: BuildDir,
        manifest: &Manifest,
        drives: Vec<PathBuf>,
        set: Vec<(String, String)>,
        remaps: Vec<Remap>,
    ) -> Result<Options, Failure> {
        let header = self.header();
        let remaps = if remaps.is_empty() {
            let journaled = header.remaps.iter();
            journaled.map(|(from, to)| Remap { from: from.clone(), to: to.clone() }).collect()
        } else {
            remaps
        };
        let mut options = Options { lambda, build, drives, config: Vec::new(), remaps };
        // The files first: in those of another lambda, the journal's config may not even exist.
        let without_config = Header { config: serde_json::Map::new(), ..header.clone() };
        compare(&without_config, &options, manifest)?;
        let set = if set.is_empty() { assignments(header) } else { set };
        options.config = ConfigSet::resolve(manifest, &set)?;
        compare(header, &options, manifest)?;
        Ok(options)
    }
}

/// The config of a journal, as `--set` would give it.
fn assignments(header: &Header) -> Vec<(String, String)> {
    let text = |value: &Value| match value {
        Value::String(text) => text.clone(),
        // As the manifest writes a whole number that is a float.
        Value::Number(number) if number.is_f64() => ConfigValue::Float(number.as_f64().unwrap_or(0.0)).to_string(),
        other => other.to_string(),
    };
    header.config.iter().map(|(key, value)| (key.clone(), text(value))).collect()
}

fn compare(header: &Header, options: &Options, manifest: &Manifest) -> Result<(), Failure> {
    let Options { build, config, remaps, .. } = options;
    let (engine, clock) = (header.engine.clone(), header.clock.as_str());
    let now = Identity { manifest, build, config, remaps, engine, clock }.header()?;
    match header.differs_from(&now) {
        None => Ok(()),
        Some(difference) => Err(different("this is not the lambda that wrote the journal", &difference)
            .with_help("name the folder of the lambda that wrote it, with the build, --set and --remap of then")),
    }
}

/// Two sides that should be equal.
pub(super) fn different(message: impl Into<String>, difference: &Difference) -> Failure {
    let Difference { what, journal, now } = difference;
    let mut failure = Failure::new(Exit::Differs, message);
    failure.causes = vec![format!("{what}\nin the journal: {journal}\nnow:            {now}")];
    failure
}

fn unusable(path: &Path, error: &JournalError) -> Failure {
    let failure = Failure::caused_by(Exit::Usage, format!("the journal in `{}` cannot be used", path.display()), error);
    match error {
        JournalError::Damaged { .. } => {
            failure.with_help("it was changed after it was written: copy it again, or write a new one")
        }
        JournalError::NotAJournal if begins_as_mcap(path) => {
            failure.with_help("it is an MCAP file; to verify a clip: gleaner verify CLIP --lambda DIR")
        }
        _ => failure.with_help("name a file that `gleaner replay --journal FILE` wrote"),
    }
}

fn begins_as_mcap(path: &Path) -> bool {
    let mut start = [0; 5];
    File::open(path).and_then(|mut file| file.read_exact(&mut start)).is_ok_and(|()| start == *b"\x89MCAP")
}
