//! `gleaner-runtime check`: a lambda without any sample. It is loaded as on a vehicle, its rings are made, and its `init` is run,
//! which finds inputs that the manifest lacks and fields that their types lack.
//!
//! What the types are is said by the definitions that lie with the lambda, on this machine, or in this program.

use std::io::Write;
use std::time::Instant;

use clap::Args;
use gleaner_jail::Paths;
use gleaner_protocol::manifest::{Manifest, Store};
use gleaner_protocol::{BuildDir, Checked, Exit, Failure, Need, Place, Report};
use gleaner_transport::loopback::Loopback;
use gleaner_transport::message::Sources;

use crate::input::{Live, Remap, live_slots};
use crate::isolation::definitions;
use crate::stage::{Asked, AskedArgs, Bounds, Load, Stage, not_started};

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
        read.extend(gleaner_protocol::parts::cache_dir().ok());
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
        let mut stage = Stage::set(&mut topics, &asked, &manifest, bounds, Some(&Live { bell: None }), load)?;
        // Without its type, a field that is there would be missing.
        let init_ms = if notes.is_empty() {
            let started = Instant::now();
            stage.guest.init().map_err(|fault| not_started(manifest.lambda.name.as_str(), fault))?;
            Some(started.elapsed().as_secs_f64() * 1e3)
        } else {
            None
        };
        let checked = Checked {
            lambda: manifest.lambda.name.to_string(),
            version: manifest.lambda.version.to_string(),
            kind: manifest.lambda.kind,
            engine: stage.guest.engine(),
            init_ms,
            resident_bytes: gleaner_vitals::usage::resident(),
            needs: needs(&asked, &manifest),
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
    let (mut topics, mut notes) = (Loopback::new(), Vec::new());
    for input in &manifest.inputs {
        let type_name = input.type_name.as_str();
        let text = sources.find(type_name).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("the definition of `{type_name}` makes no sense"), &error)
        })?;
        if text.is_none() {
            notes.push(format!(
                "no definition of `{type_name}`, of input `{}`, is on this machine: `init` was not run. Its .msg files may lie in msg/ beside \
                 lambda.toml; a drive or the node that writes the topic brings its own",
                input.name
            ));
        }
        topics.add_topic(Remap::apply(&asked.remaps, input.topic.as_str()), type_name, text.as_deref().unwrap_or(""));
    }
    Ok((topics, notes))
}

/// In the order of the manifest.
fn needs(asked: &Asked, manifest: &Manifest) -> Vec<Need> {
    let need = |purpose, bytes, at_once| Need { purpose, bytes, place: Place::Memory, at_once };
    let mut needs = Vec::new();
    for input in &manifest.inputs {
        let (slots, name) = (live_slots(input), &input.name);
        let bytes = (slots as u64).saturating_mul(input.max_size.bytes());
        needs.push(need(format!("input `{name}`: {slots} slots of {}", input.max_size), bytes, true));
        if let Some(decoded) = input.decoded_size {
            let slots = input.decoded_slots();
            let purpose = format!("input `{name}`: {slots} decoded pictures of {decoded}");
            needs.push(need(purpose, (slots as u64).saturating_mul(decoded.bytes()), true));
        }
    }
    for model in &manifest.models {
        let file = asked.build.path().join(model.file.as_path());
        let bytes = file.metadata().map_or(0, |data| data.len());
        let on_disk = Need { place: Place::Disk, ..need(format!("model `{}`", model.name), bytes, true) };
        needs.push(on_disk);
    }
    if let Some(record) = &manifest.record {
        let place = match record.store {
            Store::Ram => Place::Memory,
            Store::Disk => Place::Disk,
        };
        let preroll = need("preroll, in the recorder".to_owned(), record.preroll_size.bytes(), false);
        needs.push(Need { place, ..preroll });
    }
    let limits = &manifest.limits;
    needs.push(need("the lambda itself (`memory`)".to_owned(), limits.memory.bytes(), false));
    needs.push(need("frames that it makes (`memory`, once more)".to_owned(), limits.memory.bytes(), false));
    if limits.scratch.bytes() > 0 {
        needs.push(need("what it keeps (`scratch`)".to_owned(), limits.scratch.bytes(), false));
    }
    needs
}
