//! Arguments of `gleaner verify`.

use std::path::PathBuf;

use clap::Args;

/// Arguments of `gleaner verify`.
#[derive(Args, Debug)]
pub struct VerifyArgs {
    /// A clip that Gleaner recorded
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(long, value_name = "DIR", required_unless_present = "signature_only")]
    pub lambda: Option<PathBuf>,
    /// Check the signature of the clip first: FILE lists the vehicles to trust, a line `NAME
    /// PUBLICKEY` each
    #[arg(long, value_name = "FILE")]
    pub trust: Option<PathBuf>,
    /// Check only the signature
    #[arg(long, requires = "trust", conflicts_with_all = ["lambda", "vehicle"])]
    pub signature_only: bool,
    /// Configuration file of the vehicle [default: the limits in the journal]
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}
