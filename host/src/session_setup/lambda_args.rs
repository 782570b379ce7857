//! Arguments that name the lambda to run and its settings, and their check against the manifest.

use std::path::{Path, PathBuf};

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, Manifest, Tightened};
use gleaner_lambda::{BuildDir, Vehicle};

use crate::input::Remap;

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
}

/// A lambda with its settings, checked.
pub struct ConfiguredLambda {
    /// Its folder.
    pub folder: PathBuf,
    /// Its build, which is not older than its sources.
    pub build: BuildDir,
    /// All of `[config]`: the defaults with the overrides applied.
    pub config: Vec<(String, ConfigValue)>,
    /// Other names for topics of the manifest.
    pub remaps: Vec<Remap>,
    /// The configuration of the vehicle, which an interpreter reads again.
    pub vehicle: Option<PathBuf>,
}

impl ConfiguredLambda {
    /// Checks the overrides against the manifest, and applies the limits of the vehicle to
    /// `manifest`.
    ///
    /// # Errors
    ///
    /// A failure that names the key or the topic, and the way out.
    pub fn new(
        args: LambdaArgs,
        build: BuildDir,
        manifest: &mut Manifest,
    ) -> Result<Self, Failure> {
        let LambdaArgs { lambda, set, remap: remaps, vehicle } = args;
        if let Some(vehicle) = &vehicle {
            tighten(manifest, vehicle)?;
        }
        let config = ConfigSet::resolve(manifest, &set)?;
        known_topics(&remaps, manifest)?;
        Ok(Self { folder: lambda, build, config, remaps, vehicle })
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
