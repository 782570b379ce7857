//! `gleaner-runtime drive`: what is in a recorded drive, without a lambda.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use gleaner_protocol::{DriveSeen, Exit, Failure, RecordedTopicSeen, Report};
use gleaner_transport::Transport;
use gleaner_transport::message::Sources;
use gleaner_transport::replay::{Options, Replay};

use super::open::DriveError;
use crate::isolation::definitions;

/// Arguments of `drive`.
#[derive(Args, Clone, Debug)]
pub struct LookArgs {
    /// MCAP files, databases and directories of rosbag2.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
}

/// Opens the drives, and reports their topics.
///
/// # Errors
///
/// A failure that names the drive that cannot be opened.
pub fn look(args: &LookArgs, reports: &mut dyn Write) -> Result<Exit, Failure> {
    let options = Options { sources: Some(Sources::new(&[], &definitions())), ..Options::default() };
    let drive = Replay::open_as(&args.drives, &options).map_err(DriveError)?;
    let topics = drive.topics().into_iter().map(|found| RecordedTopicSeen {
        topic: found.topic,
        type_name: found.type_name,
        messages: found.messages,
        is_defined: found.definitions_text.is_some(),
    });
    let seen = DriveSeen { start_ns: drive.start_ns(), end_ns: drive.end_ns(), topics: topics.collect() };
    super::report(reports, &Report::Drive(seen));
    Ok(Exit::Ok)
}
