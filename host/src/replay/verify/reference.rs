//! The reference journal of a comparison: opens it and checks that it fits the lambda.

use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, excerpt, safe_file};
use gleaner_drives::{ReplayError, read_extras};
use gleaner_journal::{Difference, JournalEntry, JournalError, JournalHeader, JournalReader};
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, Manifest, Tightened};
use gleaner_recorder::{ClaimMismatch, ClipStatements};
use serde_json::Value;

use crate::api::models::Models;
use crate::input::Remap;
use crate::journal::CLOCK_OF_DRIVE;
use crate::replay::journal_file;
use crate::replay::open::DriveError;
use crate::replay::options::{Drives, ReplayOptions};
use crate::replay::time_range::RequestedRange;
use crate::session_setup::{ConfiguredLambda, LambdaArgs, tighten};

/// Upper bound of the bytes read of a clip's attachments and metadata: a journal part has 64 MiB at
/// most.
const EXTRAS_BYTES: u64 = 256 << 20;

/// An open journal, with which decisions are compared.
pub(in crate::replay) struct ReferenceJournal {
    path: PathBuf,
    reader: JournalReader<Box<dyn Read + Send>>,
    /// Metadata of the clip that contains it, where it begins in the middle of a run; `None` for
    /// the journal of a replay.
    pub(in crate::replay) clip: Option<ClipStatements>,
    /// Notes on limits for which the journal's value is used, not the manifest's.
    pub(super) limits: Vec<String>,
    /// The engine that runs the lambda again, once it is loaded.
    pub(super) engine_now: Option<String>,
}

impl ReferenceJournal {
    /// Opens the journal of a replay.
    pub(in crate::replay) fn journal(path: &Path) -> Result<Self, Failure> {
        let file = journal_file::read(path)?;
        let reference = Self::open(path, Box::new(BufReader::new(file)))?;
        if reference.is_live() {
            let message = format!("the journal in `{}` is of a live run", path.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("verify the clip that holds it: gleaner verify CLIP --lambda DIR"));
        }
        Ok(reference)
    }

    pub(super) fn is_live(&self) -> bool {
        self.header().clock != CLOCK_OF_DRIVE
    }

    pub(in crate::replay) fn path(&self) -> &Path {
        &self.path
    }

    /// Opens the part of the journal of `lambda` that a clip holds.
    pub(in crate::replay) fn clip(path: &Path, lambda: &str) -> Result<Self, Failure> {
        let mut extras = read_extras(path, EXTRAS_BYTES).map_err(unreadable_clip)?;
        if !extras.is_whole {
            let message = format!("clip `{}` is truncated or was never finished", path.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("copy it again; a complete clip of Gleaner has an end record"));
        }
        if let Some(misfit) = &extras.misfit {
            let mut failure = Failure::new(
                Exit::Differs,
                format!("clip `{}` was not written by a recorder in this form", path.display()),
            );
            failure.causes = vec![format!("it has {misfit}")];
            return Err(failure.with_help(
                "the clip was changed after it was written; readers may find other messages in it",
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
                "name a clip that Gleaner recorded; a clip has no journal if its recorder was killed"
                    .to_owned()
            } else {
                format!("it holds `{}`: name that lambda with --lambda", others.join("`, `"))
            };
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        };
        let part = std::mem::take(&mut part.data);
        let mut reference = Self::open(path, Box::new(Cursor::new(part)))?;
        let stated = ClipStatements::read(&extras, reference.header())
            .map_err(|error| contradiction(path, &error))?;
        reference.clip = Some(stated);
        Ok(reference)
    }

    fn open(path: &Path, bytes: Box<dyn Read + Send>) -> Result<Self, Failure> {
        let reader = JournalReader::open(bytes).map_err(|error| unusable(path, &error))?;
        Ok(Self { path: path.to_owned(), reader, clip: None, limits: Vec::new(), engine_now: None })
    }

    /// The failure of a journal without a complete wake.
    pub(super) fn empty(&self) -> Failure {
        let message = format!("the journal in `{}` holds no complete wake", self.path.display());
        Failure::new(Exit::Usage, message)
            .with_help("its writer died early, or the file was truncated: write a new one")
    }

    pub(super) fn header(&self) -> &JournalHeader {
        self.reader.header()
    }

    /// Reads the next wake; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<JournalEntry>, Failure> {
        self.reader.next().map_err(|error| unusable(&self.path, &error))
    }

    pub(super) fn reader(&self) -> &JournalReader<Box<dyn Read + Send>> {
        &self.reader
    }

    /// Returns the options with which the journal was written. Values in `set`, `remaps` and the
    /// vehicle take precedence, and must be equal to those of the journal. Without a vehicle,
    /// limits of the journal that are lower than those of the manifest are taken for those of its
    /// vehicle, and noted; they cannot be higher.
    pub(in crate::replay) fn options(
        &mut self,
        args: LambdaArgs,
        build: BuildDir,
        manifest: &mut Manifest,
        drives: Drives,
    ) -> Result<ReplayOptions, Failure> {
        let LambdaArgs { lambda: folder, set, remap: remaps, vehicle, .. } = args;
        let passes_inference = args.starter_passes_inference;
        let header = self.reader.header();
        match &vehicle {
            Some(file) => tighten(manifest, file)?,
            None => {
                let (limits, tightened) = manifest.limits.tightened_by(&header.limits);
                manifest.limits = limits;
                let note = |Tightened { key, from, to }| {
                    format!(
                        "limit `{key}`: {to} in the journal, which is used, {from} in lambda.toml; \
                         --vehicle FILE compares it"
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
        let (config, models) = (Vec::new(), Models::default());
        let mut lambda =
            ConfiguredLambda { folder, build, config, remaps, vehicle, models, passes_inference };
        // The files first: another lambda may not even have the keys of the journal's config.
        let without_config = JournalHeader { config: serde_json::Map::new(), ..header.clone() };
        compare(&without_config, &lambda, manifest)?;
        let set = if set.is_empty() { assignments(header) } else { set };
        lambda.config = ConfigSet::resolve(manifest, &set)?;
        compare(header, &lambda, manifest)?;
        // A clip is used as a whole.
        let range = if self.clip.is_some() {
            RequestedRange::default()
        } else {
            RequestedRange::from(header.part)
        };
        Ok(ReplayOptions {
            lambda,
            drives,
            // They are those of the journal.
            merge: true,
            range,
            topics: Vec::new(),
            unpack_in: None,
            unpacked: Vec::new(),
        })
    }
}

/// The config of a journal as arguments of `--set`.
fn assignments(header: &JournalHeader) -> Vec<(String, String)> {
    let text = |value: &Value| match value {
        Value::String(text) => text.clone(),
        // Floats with integer values are written as in the manifest.
        Value::Number(number) if number.is_f64() => {
            ConfigValue::Float(number.as_f64().unwrap_or(0.0)).to_string()
        }
        other => other.to_string(),
    };
    header.config.iter().map(|(key, value)| (key.clone(), text(value))).collect()
}

fn compare(
    header: &JournalHeader,
    lambda: &ConfiguredLambda,
    manifest: &Manifest,
) -> Result<(), Failure> {
    let now = lambda.header(manifest, &header.engine, &header.clock, header.part)?;
    match header.differs_from(&now) {
        None => Ok(()),
        Some(difference) => Err(different(
            "this is not the lambda that wrote the journal",
            &difference,
        )
        .with_help(
            "name the folder of the lambda that wrote it, with the same build, --set, --remap and \
                 --vehicle",
        )),
    }
}

/// The failure for two values that should be equal.
pub(super) fn different(message: impl Into<String>, difference: &Difference) -> Failure {
    let Difference { what, journal, now } = difference;
    let mut failure = Failure::new(Exit::Differs, message);
    failure.causes = vec![format!("{what}\nin the journal: {journal}\nnow:            {now}")];
    failure
}

/// The failure of a clip whose metadata contradicts its messages or its journal.
pub(super) fn contradiction(
    path: &Path,
    ClaimMismatch { what, stated, found }: &ClaimMismatch,
) -> Failure {
    let mut failure =
        Failure::new(Exit::Differs, format!("clip `{}` contradicts itself", path.display()));
    failure.causes = vec![format!("{what}\nstated:    {stated}\nexpected:  {found}")];
    failure.with_help(
        "the clip was changed after it was written, or an older gleaner wrote it: replay the \
         lambda over its drive again",
    )
}

fn unusable(path: &Path, error: &JournalError) -> Failure {
    let failure = Failure::caused_by(
        Exit::Usage,
        format!("the journal in `{}` cannot be used", path.display()),
        error,
    );
    match error {
        JournalError::Damaged { .. } => failure.with_help(
            "the journal was changed after it was written: copy it again, or write a new one",
        ),
        JournalError::NotAJournal if begins_as_mcap(path) => failure.with_help(
            "the file is an MCAP file; to verify a clip: gleaner verify CLIP --lambda DIR",
        ),
        _ => failure.with_help("name a file that `gleaner replay --journal FILE` wrote"),
    }
}

/// The failure of a clip that is unreadable or damaged.
pub(super) fn unreadable_clip(error: ReplayError) -> Failure {
    Failure::from(DriveError(error))
        .with_help("name a clip that Gleaner recorded, or copy the clip again")
}

fn begins_as_mcap(path: &Path) -> bool {
    let mut start = [0; 5];
    safe_file::read_named(path)
        .and_then(|mut file| file.read_exact(&mut start))
        .is_ok_and(|()| start == *b"\x89MCAP")
}
