//! Arguments of `gleaner keys` and `gleaner publish`, and those of `gleaner run` that sign clips.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use gleaner_trust::VehicleName;

/// Commands of `gleaner keys`.
#[derive(Subcommand, Debug)]
pub enum KeysCommand {
    /// Create a key in a new file that only you can read, and show its public key
    New(KeysArgs),
    /// Show the public key and the id of a key
    Show(KeysArgs),
}

/// Arguments of `gleaner keys new` and `gleaner keys show`.
#[derive(Args, Debug)]
pub struct KeysArgs {
    /// The key file
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner publish`.
#[derive(Args, Debug)]
pub struct PublishArgs {
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
    /// The key file of the publisher, made by `gleaner keys new FILE`
    #[arg(long, value_name = "FILE")]
    pub key: PathBuf,
    /// The file to write [default: DIR/revision.json]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Number of the release, higher than all before [default: 1, or the next after that in the
    /// file, if the key signed it]
    #[arg(long, value_name = "N")]
    pub release: Option<u64>,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Options of `gleaner run` that sign clips.
#[derive(Args, Debug)]
pub struct SignArgs {
    /// Sign each clip with this key file of the vehicle, made by `gleaner keys new FILE`
    #[arg(long, value_name = "FILE", conflicts_with = "no_record")]
    pub sign: Option<PathBuf>,
    /// Name of the vehicle in the signatures [default: the name of this machine]
    #[arg(long, value_name = "NAME", requires = "sign")]
    pub vehicle_name: Option<VehicleName>,
}
