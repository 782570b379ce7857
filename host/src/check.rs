//! `gleaner-runtime check`: a lambda without any sample. It is loaded as on a vehicle, its rings
//! are made, and its `init` is run, which finds inputs that the manifest lacks and fields that
//! their types lack.
//!
//! What the types are is said by the definitions that lie with the lambda, on this machine, or in
//! this program.

use std::io::Write;
use std::time::Instant;

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_buffers::Pool;
use gleaner_jail::Paths;
use gleaner_lambda::manifest::{Manifest, Store};
use gleaner_lambda::{BuildDir, Fault};
use gleaner_messages::Sources;
use gleaner_protocol::{Checked, Need, Place, Report};
use gleaner_transport::SampleMeta;
use gleaner_transport::loopback::Loopback;

use crate::api::frame::Info;
use crate::input::{Live, Remap, live_slots, unfinished_bytes};
use crate::isolation::{code, definitions};
use crate::stage::{Asked, AskedArgs, Bounds, Load, Stage, not_started};

/// What the recorder may take beside the preroll: two staging areas, and what is on its way to the
/// disk.
const RECORDER: u64 = (2 * 256 + 16) << 20;

/// Arguments of `check`.
#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    #[command(flatten)]
    asked: AskedArgs,
}

/// A lambda to look at.
pub struct Job {
    /// Which lambda.
    pub asked: Asked,
    /// Its manifest.
    pub manifest: Manifest,
}

impl Job {
    /// Checks the arguments against the build and its manifest.
    ///
    /// # Errors
    ///
    /// A failure that names the manifest's line, the key or the topic, and the way out.
    pub fn new(args: CheckArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.asked.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let asked = Asked::new(args.asked, build, &mut manifest)?;
        Ok(Self { asked, manifest })
    }

    /// What may be opened while `init` runs.
    pub fn paths(&self) -> Paths {
        let mut read = definitions();
        read.push(self.asked.lambda.clone());
        read.extend(self.asked.vehicle.clone());
        read.extend(code(self.manifest.lambda.kind));
        Paths { read, write: Vec::new() }
    }

    /// Does it, and reports what was found.
    ///
    /// # Errors
    ///
    /// Why the lambda cannot start.
    pub fn run(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        let Self { asked, manifest } = self;
        let (mut topics, notes) = topics(&asked, &manifest)?;
        let bounds = Bounds::Live(manifest.limits.deadline);
        let mut stage =
            Stage::set(&mut topics, &asked, &manifest, bounds, Some(&Live { bell: None }), load)?;
        // Without its type, a field that is there would be missing.
        let mut log = Vec::new();
        let mut started = |outcome: Result<(), Fault>| {
            let (said, _) = stage.session.take_log();
            outcome.map_err(|fault| not_started(manifest.lambda.name.as_str(), fault, &said))?;
            log.extend(said.into_iter().map(|line| line.message));
            Ok::<_, Failure>(())
        };
        started(stage.guest.prepare())?;
        let mut init_ms = None;
        if notes.is_empty() {
            let begun = Instant::now();
            started(stage.guest.init())?;
            init_ms = Some(begun.elapsed().as_secs_f64() * 1e3);
        }
        let checked = Checked {
            lambda: manifest.lambda.name.to_string(),
            version: manifest.lambda.version.to_string(),
            kind: manifest.lambda.kind,
            engine: stage.guest.engine(),
            init_ms,
            resident_bytes: stage.guest.resident_bytes(),
            needs: needs(&asked, &manifest),
            log,
            notes,
        };
        // Whoever asked may have gone.
        let _ = serde_json::to_writer(&mut *reports, &Report::Checked(Box::new(checked)));
        let _ = reports.write_all(b"\n");
        Ok(Exit::Ok)
    }
}

/// The lambda's topics, on which nothing comes; and notes on those whose type is not known here.
fn topics(asked: &Asked, manifest: &Manifest) -> Result<(Loopback, Vec<String>), Failure> {
    let sources = Sources::new(&[asked.build.path().join("msg")], &definitions());
    let (topics, mut notes) = (Loopback::new(), Vec::new());
    for input in &manifest.inputs {
        let type_name = input.type_name.as_str();
        let text = sources.find(type_name).map_err(|error| {
            Failure::caused_by(
                Exit::Usage,
                format!("the definition of `{type_name}` makes no sense"),
                &error,
            )
        })?;
        if text.is_none() {
            notes.push(format!(
                "no definition of `{type_name}`, of input `{}`, is on this machine: `init` was not run. Its .msg files may lie in msg/ beside \
                 lambda.toml; a drive or the node that writes the topic brings its own",
                input.name
            ));
        }
        topics.add_topic(
            Remap::apply(&asked.remaps, input.topic.as_str()),
            type_name,
            text.as_deref().unwrap_or(""),
        );
    }
    Ok((topics, notes))
}

/// Those of the lambda's own process in the order of the manifest, then those of the recorder, then
/// the disk.
fn needs(asked: &Asked, manifest: &Manifest) -> Vec<Need> {
    let limits = &manifest.limits;
    let mut needs = Vec::new();
    let mut need = |place, preallocated, purpose: String, bytes| {
        needs.push(Need { purpose, bytes, place, preallocated })
    };
    for input in &manifest.inputs {
        let (name, slots) = (&input.name, live_slots(input));
        let bytes = Pool::<SampleMeta>::bytes_needed(slots, input.max_size.as_usize());
        let purpose = format!("input `{name}`: {slots} slots of {}", input.max_size);
        need(Place::Memory, true, purpose, bytes.map(|bytes| bytes as u64));
        if let Some(decoded) = input.decoded_size {
            let slots = input.decoded_slots();
            let bytes = Pool::<Info>::bytes_needed(slots, decoded.as_usize());
            let purpose = format!("input `{name}`: {slots} decoded pictures of {decoded}");
            need(Place::Memory, true, purpose, bytes.map(|bytes| bytes as u64));
        }
    }
    need(
        Place::Memory,
        false,
        "the lambda itself (`memory`)".to_owned(),
        Some(limits.memory.bytes()),
    );
    if manifest.inputs.iter().any(|input| input.type_name.is_frame()) {
        need(
            Place::Memory,
            false,
            "frames that it makes (`memory`, once more)".to_owned(),
            Some(limits.memory.bytes()),
        );
    }
    if limits.scratch.bytes() > 0 {
        let bytes = limits.scratch.bytes().saturating_mul(2);
        need(
            Place::Memory,
            false,
            "what it keeps (`scratch`, twice while an entry grows)".to_owned(),
            Some(bytes),
        );
    }
    let unfinished = Some(unfinished_bytes(manifest));
    need(
        Place::Memory,
        false,
        "decisions and messages on their way, while the network loses parts".to_owned(),
        unfinished,
    );
    if let Some(record) = &manifest.record {
        let (place, preallocated) = match record.store {
            Store::Ram => (Place::Memory, true),
            Store::Disk => (Place::Disk, false),
        };
        need(
            place,
            preallocated,
            "recorder: preroll".to_owned(),
            Some(record.preroll_size.bytes()),
        );
        need(
            Place::Memory,
            false,
            "recorder: messages on their way, and clips being written".to_owned(),
            Some(RECORDER),
        );
        need(
            Place::Disk,
            false,
            "clips; `gleaner run --clips-max --bytes-max` bounds them".to_owned(),
            None,
        );
    }
    for model in &manifest.models {
        let file = asked.build.path().join(model.file.as_path());
        need(
            Place::Disk,
            true,
            format!("model `{}`", model.name),
            file.metadata().ok().map(|data| data.len()),
        );
    }
    need(Place::Disk, false, "decisions.jsonl and log.jsonl".to_owned(), None);
    needs
}
