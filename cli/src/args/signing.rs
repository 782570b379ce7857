//! Arguments of `gleaner keys` and `gleaner publish`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

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
