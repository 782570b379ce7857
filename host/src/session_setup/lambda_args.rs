//! Arguments that name the lambda to run and its settings, and their check against the manifest.

use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_base::{ByteSize, Exit, Failure, PlainFile};
use gleaner_journal::{JournalHeader, TimeRange};
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, Manifest, ModelSpec, Tightened};
use gleaner_lambda::{BuildDir, Vehicle};
use gleaner_pixels::vision::DetectorLayout;
use gleaner_protocol::{Handover, PASSES_INFERENCE};

use crate::api::models::{ModelEntry, Models};
use crate::input::Remap;
use crate::journal::{IdentityError, LambdaIdentity};

/// Longest file of labels; one of a thousand classes has some 10 kB.
const LABELS_MAX: ByteSize = ByteSize::mib(1);

/// Arguments that name the lambda to run and its settings.
#[derive(Args, Clone, Debug)]
pub struct LambdaArgs {
    /// The lambda's folder, built by `gleaner build`.
    pub lambda: PathBuf,
    /// A value of the table `config` of the manifest.
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    /// Another name for a topic of the manifest.
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<Remap>,
    /// The configuration of the vehicle; its limits lower those of the manifest.
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Standard input is a socket of the starter, which passes the connection to gleaner-inference.
    #[arg(long = PASSES_INFERENCE, hide = true)]
    pub starter_passes_inference: bool,
}

pub struct ConfiguredLambda {
    pub folder: PathBuf,
    /// Its build, which is not older than its sources.
    pub build: BuildDir,
    /// All of `[config]`: the defaults with the overrides applied.
    pub config: Vec<(String, ConfigValue)>,
    pub remaps: Vec<Remap>,
    /// The configuration of the vehicle, which an interpreter reads again.
    pub vehicle: Option<PathBuf>,
    /// Its models, connected to the process that runs them if there is one.
    pub models: Models,
    /// Set if the starter passes that connection over standard input.
    pub passes_inference: bool,
}

impl ConfiguredLambda {
    /// Checks the overrides against the manifest, and applies the limits of the vehicle to
    /// `manifest`.
    pub fn new(
        args: LambdaArgs,
        build: BuildDir,
        manifest: &mut Manifest,
    ) -> Result<Self, Failure> {
        let LambdaArgs { lambda, set, remap: remaps, vehicle, .. } = args;
        let passes_inference = args.starter_passes_inference;
        if let Some(vehicle) = &vehicle {
            tighten(manifest, vehicle)?;
        }
        let config = ConfigSet::resolve(manifest, &set)?;
        known_topics(&remaps, manifest)?;
        let models = Models::default();
        Ok(Self { folder: lambda, build, config, remaps, vehicle, models, passes_inference })
    }

    /// Describes the lambda in an engine of this name, for a journal of `part` by `clock`.
    pub(crate) fn header(
        &self,
        manifest: &Manifest,
        engine: &str,
        clock: &str,
        part: TimeRange,
    ) -> Result<JournalHeader, IdentityError> {
        let (Self { build, config, remaps, .. }, engine) = (self, engine.to_owned());
        LambdaIdentity { manifest, build, config, remaps, engine, clock, part }.header()
    }

    /// Opens its models over the connection that the starter passes on standard input, if it does.
    ///
    /// # Errors
    ///
    /// A failure if that connection does not arrive, or if labels cannot be read.
    pub fn connect_models(&mut self, manifest: &Manifest) -> Result<(), Failure> {
        let mut socket = None;
        if self.passes_inference {
            let unconnected = |error| Failure::because("cannot receive the connections", &error);
            let connections = Handover::receive(take_stdin()?).map_err(unconnected)?;
            socket = connections.inference;
        }
        self.use_models(manifest, socket)
    }

    /// Opens its models over `socket`, if there is one. Fails if labels cannot be read.
    pub fn use_models(
        &mut self,
        manifest: &Manifest,
        socket: Option<OwnedFd>,
    ) -> Result<(), Failure> {
        if manifest.models.is_empty() {
            return Ok(());
        }
        let entries = manifest.models.iter().map(|model| model_entry(model, &self.build));
        let memory = manifest.limits.memory.bytes();
        self.models = Models::new(entries.collect::<Result<_, _>>()?, socket, memory);
        self.models.open_all(manifest.limits.init_deadline);
        Ok(())
    }
}

/// Lowers the limits of `manifest` to those of the vehicle described in `file`.
///
/// # Errors
///
/// A failure that names the file, the line and the key.
pub fn tighten(manifest: &mut Manifest, file: &Path) -> Result<(), Failure> {
    let (limits, tightened) = manifest.limits.tightened_by(&Vehicle::load(file)?.limits);
    manifest.limits = limits;
    if !tightened.is_empty() {
        let limits = tightened.iter().map(Tightened::to_string).collect::<Vec<_>>().join(", ");
        let (lambda, by) = (&manifest.lambda.name, file.display());
        tracing::warn!(%lambda, %by, %limits, "limits lowered by the vehicle's configuration");
    }
    Ok(())
}

/// Reads what the host needs of a model.
fn model_entry(model: &ModelSpec, build: &BuildDir) -> Result<ModelEntry, Failure> {
    let layout =
        model.layout.as_deref().map(DetectorLayout::from_name).transpose().map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot use model `{}`", model.name), &error)
        })?;
    let labels = match &model.labels {
        None => Vec::new(),
        Some(file) => {
            let failed = |error: io::Error| {
                let message = format!("cannot read `{file}`, the labels of model `{}`", model.name);
                Failure::caused_by(Exit::Usage, message, &error)
            };
            let mut text = String::new();
            PlainFile::inside(build.path(), file.as_path(), LABELS_MAX)
                .and_then(|mut file| file.read_to_string(&mut text))
                .map_err(failed)?;
            // Editors of Windows begin a file with a byte order mark.
            let text = text.trim_start_matches('\u{feff}');
            text.lines().map(|line| line.trim().to_owned()).collect()
        }
    };
    Ok(ModelEntry { name: model.name.to_string(), layout, labels })
}

/// Takes the starter's socket from standard input and replaces it by /dev/null: a lambda may read
/// its standard input.
pub(crate) fn take_stdin() -> Result<OwnedFd, Failure> {
    let failed = |error: io::Error| {
        Failure::caused_by(Exit::Internal, "cannot take the socket of the parent process", &error)
    };
    let socket =
        rustix::io::fcntl_dupfd_cloexec(io::stdin(), 3).map_err(io::Error::from).map_err(failed)?;
    let nothing = std::fs::File::open("/dev/null").map_err(failed)?;
    rustix::stdio::dup2_stdin(&nothing).map_err(io::Error::from).map_err(failed)?;
    Ok(socket)
}

fn assignment(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE, as in brake_mps2=-1.4")?;
    Ok((key.trim().to_owned(), value.trim().to_owned()))
}

fn remap(text: &str) -> Result<Remap, String> {
    let (from, to) = text.split_once(":=").ok_or("write FROM:=TO, as in /imu/data:=/car/imu")?;
    Ok(Remap { from: from.trim().to_owned(), to: to.trim().to_owned() })
}

/// Refuses a remap of a topic that the manifest does not have.
fn known_topics(remaps: &[Remap], manifest: &Manifest) -> Result<(), Failure> {
    let inputs = manifest.inputs.iter().map(|input| input.topic.as_str());
    let recorded =
        manifest.record.iter().flat_map(|record| &record.topics).map(|topic| topic.as_str());
    let mut known: Vec<&str> = Vec::new();
    for topic in inputs.chain(recorded) {
        if !known.contains(&topic) {
            known.push(topic);
        }
    }
    match remaps.iter().find(|remap| !known.contains(&remap.from.as_str())) {
        None => Ok(()),
        Some(remap) => {
            let failure = Failure::new(
                Exit::Usage,
                format!("no input has the topic `{}` of --remap", remap.from),
            );
            Err(failure.with_help(format!("the manifest has `{}`", known.join("`, `"))))
        }
    }
}
