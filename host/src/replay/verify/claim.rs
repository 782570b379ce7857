//! What a journal claims: which lambda decided what, and where that is written.

use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, excerpt, own_file};
use gleaner_drives::{ReplayError, read_extras};
use gleaner_journal::{Difference, Entry, Header, JournalError, Reader};
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, Manifest, Tightened};
use gleaner_recorder::{Stated, Untrue};
use serde_json::Value;

use crate::input::Remap;
use crate::journal::{CLOCK_OF_VEHICLE, Identity};
use crate::replay::journal_file;
use crate::replay::open::DriveError;
use crate::replay::options::{Drives, Options};
use crate::replay::part::Wanted;
use crate::stage::{Asked, AskedArgs, tighten};

/// Most bytes of a clip's attachments and metadata that are read: a journal part has 64 MiB at
/// most.
const EXTRAS_BYTES: u64 = 256 << 20;

/// A journal, opened.
pub(in crate::replay) struct Claim {
    path: PathBuf,
    reader: Reader<Box<dyn Read + Send>>,
    /// Statements of the clip that it is a part of, and begins in the middle of; none for the
    /// journal of a replay.
    pub(in crate::replay) clip: Option<Stated>,
    /// Limits that held by the journal and not by the manifest.
    pub(super) limits: Vec<String>,
}

impl Claim {
    /// The journal of a replay.
    pub(in crate::replay) fn journal(path: &Path) -> Result<Self, Failure> {
        let file = journal_file::read(path)?;
        Self::open(path, Box::new(BufReader::new(file)))
    }

    /// The file that it is in.
    pub(in crate::replay) fn path(&self) -> &Path {
        &self.path
    }

    /// The part of the journal of `lambda` that a clip holds.
    pub(in crate::replay) fn clip(path: &Path, lambda: &str) -> Result<Self, Failure> {
        let mut extras = read_extras(path, EXTRAS_BYTES).map_err(unreadable_clip)?;
        if !extras.is_whole {
            let message = format!("clip `{}` is cut off or was never finished", path.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("copy it again; a clip of Gleaner has its end"));
        }
        if let Some(misfit) = &extras.misfit {
            let mut failure = Failure::new(
                Exit::Differs,
                format!("clip `{}` is not as a recorder writes it", path.display()),
            );
            failure.causes = vec![format!("it has {misfit}")];
            return Err(failure.with_help(
                "it was changed since it was made; readers may see other messages in it",
            ));
        }
        let wanted = format!("journal/{lambda}.journal");
        let Some(part) = extras.attachments.iter_mut().find(|attachment| attachment.name == wanted)
        else {
            let message =
                format!("clip `{}` holds no journal of lambda `{lambda}`", path.display());
            let names = extras.attachments.iter().map(|attachment| attachment.name.as_str());
            let others =
                names.filter(|name| name.starts_with("journal/")).map(excerpt).collect::<Vec<_>>();
            let help = if others.is_empty() {
                "it was recovered after its recorder had died, or is no clip of Gleaner".to_owned()
            } else {
                format!("it holds `{}`: name that lambda with --lambda", others.join("`, `"))
            };
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        };
        let part = std::mem::take(&mut part.data);
        let mut claim = Self::open(path, Box::new(Cursor::new(part)))?;
        let stated = Stated::read(&extras, claim.header()).map_err(|error| untrue(path, &error))?;
        claim.clip = Some(stated);
        Ok(claim)
    }

    fn open(path: &Path, bytes: Box<dyn Read + Send>) -> Result<Self, Failure> {
        let reader = Reader::open(bytes).map_err(|error| unusable(path, &error))?;
        if reader.header().clock == CLOCK_OF_VEHICLE {
            let message =
                format!("`{}` was recorded live, and cannot be verified yet", path.display());
            let mut failure = Failure::new(Exit::Usage, message);
            failure.causes = vec![
                "lambda and recorder each received the samples by themselves, and the clip has the recorder's stamps"
                    .to_owned(),
            ];
            return Err(
                failure.with_help("replay the lambda over the clip: gleaner replay DIR CLIP")
            );
        }
        Ok(Self { path: path.to_owned(), reader, clip: None, limits: Vec::new() })
    }

    /// A comparison of nothing proves nothing.
    pub(super) fn empty(&self) -> Failure {
        let message = format!("the journal in `{}` holds no whole wake", self.path.display());
        Failure::new(Exit::Usage, message)
            .with_help("its writer died early, or it was cut off: write a new one")
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

    /// Returns what the journal was made with, unless `set`, `remaps` and the vehicle say
    /// otherwise, which then has to be the same. Without a vehicle, limits of the journal that are
    /// tighter than those of the manifest count as those of the vehicle of then, and are noted;
    /// they cannot be wider.
    pub(in crate::replay) fn options(
        &mut self,
        args: AskedArgs,
        build: BuildDir,
        manifest: &mut Manifest,
        drives: Drives,
    ) -> Result<Options, Failure> {
        let AskedArgs { lambda, set, remap: remaps, vehicle } = args;
        let header = self.reader.header();
        match &vehicle {
            Some(file) => tighten(manifest, file)?,
            None => {
                let (limits, tightened) = manifest.limits.tightened_by(&header.limits);
                manifest.limits = limits;
                let note = |Tightened { key, from, to }| {
                    format!(
                        "limit `{key}`: {to} in the journal, which holds, {from} in lambda.toml; --vehicle FILE compares it"
                    )
                };
                self.limits = tightened.into_iter().map(note).collect();
            }
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
        let part = if self.clip.is_some() { Wanted::default() } else { Wanted::from(header.part) };
        Ok(Options {
            asked,
            drives,
            part,
            topics: Vec::new(),
            unpack_in: None,
            unpacked: Vec::new(),
        })
    }
}

/// The config of a journal, as `--set` would give it.
fn assignments(header: &Header) -> Vec<(String, String)> {
    let text = |value: &Value| match value {
        Value::String(text) => text.clone(),
        // As the manifest writes a whole number that is a float.
        Value::Number(number) if number.is_f64() => {
            ConfigValue::Float(number.as_f64().unwrap_or(0.0)).to_string()
        }
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

/// A failure: the clip makes an untrue statement about itself.
pub(super) fn untrue(path: &Path, Untrue { what, stated, found }: &Untrue) -> Failure {
    let mut failure =
        Failure::new(Exit::Differs, format!("clip `{}` contradicts itself", path.display()));
    failure.causes = vec![format!("{what}\nthe clip says:  {stated}\nit should be:   {found}")];
    failure.with_help(
        "it was changed since it was made, or an older gleaner made it: replay the lambda over its drive again",
    )
}

fn unusable(path: &Path, error: &JournalError) -> Failure {
    let failure = Failure::caused_by(
        Exit::Usage,
        format!("the journal in `{}` cannot be used", path.display()),
        error,
    );
    match error {
        JournalError::Damaged { .. } => failure
            .with_help("it was changed after it was written: copy it again, or write a new one"),
        JournalError::NotAJournal if begins_as_mcap(path) => failure
            .with_help("it is an MCAP file; to verify a clip: gleaner verify CLIP --lambda DIR"),
        _ => failure.with_help("name a file that `gleaner replay --journal FILE` wrote"),
    }
}

/// A clip that cannot be read, or is damaged.
pub(super) fn unreadable_clip(error: ReplayError) -> Failure {
    Failure::from(DriveError(error)).with_help("copy the clip again if you can")
}

fn begins_as_mcap(path: &Path) -> bool {
    let mut start = [0; 5];
    own_file::read_named(path)
        .and_then(|mut file| file.read_exact(&mut start))
        .is_ok_and(|()| start == *b"\x89MCAP")
}
