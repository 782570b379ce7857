//! What a journal claims: which lambda decided what, and where that is written.

use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use gleaner_protocol::journal::{Difference, Entry, Header, JournalError, Reader};
use gleaner_protocol::manifest::{ConfigSet, ConfigValue, Manifest};
use gleaner_protocol::{BuildDir, Exit, Failure, own_file};
use gleaner_transport::replay::{ReplayError, read_extras};
use serde_json::Value;

use super::told::Told;
use crate::input::Remap;
use crate::journal::{CLOCK_OF_VEHICLE, Identity};
use crate::replay::open::DriveError;
use crate::replay::options::{Drives, Options};
use crate::replay::part::Wanted;
use crate::stage::{Asked, AskedArgs, tighten};

/// Most bytes of a clip's attachments and metadata that are read: a journal part has 64 MiB at most.
const EXTRAS_BYTES: u64 = 256 << 20;

/// A journal, opened.
pub(in crate::replay) struct Claim {
    path: PathBuf,
    reader: Reader<Box<dyn Read + Send>>,
    /// Whether it is the part in a clip, which begins in the middle.
    pub(in crate::replay) is_part: bool,
    /// What the clip tells people; nothing for a journal.
    pub(super) told: Told,
}

impl Claim {
    /// The journal of a replay.
    pub(in crate::replay) fn journal(path: &Path) -> Result<Self, Failure> {
        let file = own_file::read_named(path).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot open journal `{}`", path.display()), &error)
        })?;
        Self::open(path, Box::new(BufReader::new(file)), false, Told::default())
    }

    /// The file that it is in.
    pub(in crate::replay) fn path(&self) -> &Path {
        &self.path
    }

    /// The part of the journal of `lambda` that a clip holds.
    pub(in crate::replay) fn clip(path: &Path, lambda: &str) -> Result<Self, Failure> {
        let extras = read_extras(path, EXTRAS_BYTES).map_err(unreadable_clip)?;
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
        if reader.header().clock == CLOCK_OF_VEHICLE {
            let message = format!("`{}` was recorded live, and cannot be verified yet", path.display());
            let mut failure = Failure::new(Exit::Usage, message);
            failure.causes = vec![
                "lambda and recorder each received the samples by themselves, and the clip has the recorder's stamps"
                    .to_owned(),
            ];
            return Err(failure.with_help("replay the lambda over the clip: gleaner replay DIR CLIP"));
        }
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

    /// What the journal was made with, unless `set`, `remaps` and the vehicle say otherwise, which then has to be the same. Limits
    /// of the journal count as those of a vehicle: they cannot be wider than those of the manifest.
    pub(in crate::replay) fn options(
        &self,
        args: AskedArgs,
        build: BuildDir,
        manifest: &mut Manifest,
        drives: Drives,
    ) -> Result<Options, Failure> {
        let AskedArgs { lambda, set, remap: remaps, vehicle } = args;
        let header = self.header();
        match &vehicle {
            Some(file) => tighten(manifest, file)?,
            None => manifest.limits = manifest.limits.tightened_by(&header.limits).0,
        }
        let remaps = if remaps.is_empty() {
            let journaled = header.remaps.iter();
            journaled.map(|(from, to)| Remap { from: from.clone(), to: to.clone() }).collect()
        } else {
            remaps
        };
        let mut asked = Asked { lambda, build, config: Vec::new(), remaps, vehicle };
        // The files first: in those of another lambda, the journal's config may not even exist.
        let without_config = Header { config: serde_json::Map::new(), ..header.clone() };
        compare(&without_config, &asked, manifest)?;
        let set = if set.is_empty() { assignments(header) } else { set };
        asked.config = ConfigSet::resolve(manifest, &set)?;
        compare(header, &asked, manifest)?;
        // A clip holds what it holds.
        let part = if self.is_part { Wanted::default() } else { Wanted::from(header.part) };
        Ok(Options { asked, drives, part, topics: Vec::new(), unpack_in: None })
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

fn compare(header: &Header, asked: &Asked, manifest: &Manifest) -> Result<(), Failure> {
    let Asked { build, config, remaps, .. } = asked;
    let (engine, clock, part) = (header.engine.clone(), header.clock.as_str(), header.part);
    let now = Identity { manifest, build, config, remaps, engine, clock, part }.header()?;
    match header.differs_from(&now) {
        None => Ok(()),
        Some(difference) => Err(different("this is not the lambda that wrote the journal", &difference).with_help(
            "name the folder of the lambda that wrote it, with the build, --set, --remap and --vehicle of then",
        )),
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

/// A clip that cannot be read, or is damaged.
pub(super) fn unreadable_clip(error: ReplayError) -> Failure {
    Failure::from(DriveError(error)).with_help("copy the clip again if you can")
}

fn begins_as_mcap(path: &Path) -> bool {
    let mut start = [0; 5];
    own_file::read_named(path).and_then(|mut file| file.read_exact(&mut start)).is_ok_and(|()| start == *b"\x89MCAP")
}
