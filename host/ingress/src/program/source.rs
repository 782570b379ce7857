//! Opens the source of samples: the network or a drive.

use gleaner_base::Failure;
use gleaner_dds::Dds;
use gleaner_drives::{DriveOptions, DrivePlayer, ReplayError};
use gleaner_messages::transport::LiveSource;

use super::args::Args;
use super::network::{NetworkError, warn_of_variables};

/// Opens the source that `args` name. The process runs in real time, or not.
pub(super) fn open(args: Args, real_time: bool) -> Result<Box<dyn LiveSource>, Failure> {
    let clock = args.clock();
    if !args.is_of_network() {
        let options = DriveOptions {
            unpack_in: args.unpack_in,
            merge: args.merge,
            ..DriveOptions::default()
        };
        let drive = DrivePlayer::open(&args.drive, &options, clock, args.rate);
        return Ok(Box::new(drive.map_err(|error| unplayable(&error))?));
    }
    warn_of_variables();
    let mut network = args.network.options(args.node).map_err(NetworkError::failure)?;
    network.largest = args.largest.unwrap_or(network.largest);
    network.clock = clock;
    network.real_time = real_time;
    // Readers search their own files for definitions.
    network.messages = Vec::new();
    network.prefixes = Vec::new();
    Ok(Box::new(Dds::open(network).map_err(NetworkError::failure)?))
}

fn unplayable(error: &ReplayError) -> Failure {
    let failure = Failure::caused_by(error.exit(), "cannot play the drive", error);
    match error.help() {
        Some(help) => failure.with_help(help),
        None => failure,
    }
}
