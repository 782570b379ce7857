//! Arguments of `gleaner verify`.

use std::path::PathBuf;

use clap::Args;

/// Arguments of `gleaner verify`.
#[derive(Args, Debug)]
pub struct VerifyArgs {
    /// A clip that Gleaner recorded
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build DIR`: the decisions in the clip are repeated
    /// with it
    #[arg(long, value_name = "DIR", required_unless_present = "trust")]
    pub lambda: Option<PathBuf>,
    /// Check the signature of the clip, first or alone: FILE lists the vehicles to trust, a line
    /// `NAME PUBLICKEY` each
    #[arg(long, value_name = "FILE")]
    pub trust: Option<PathBuf>,
    /// Configuration file of the vehicle [default: the limits in the journal]
    #[arg(long, value_name = "FILE", requires = "lambda")]
    pub vehicle: Option<PathBuf>,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}
