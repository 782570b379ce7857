//! Parses the command line.

use std::path::PathBuf;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_dds as dds;
use gleaner_dds::{Dds, NetworkArgs};
use gleaner_lambda::manifest::TopicName;
use gleaner_transport::{Clock, LiveSource};

use super::RecorderOptions;

/// Records for lambdas from live ROS 2 topics. Lambdas connect over standard input, a socket of the
/// starter; reports, one JSON object per line, go to standard output.
#[derive(Parser)]
#[command(name = "gleaner-recorder", version)]
pub(super) struct Args {
    /// Output folder: `clips.jsonl`, `clips/`.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    #[command(flatten)]
    network: NetworkArgs,
    /// Offset of the sample clock from CLOCK_MONOTONIC, in ns; default: the time of day.
    #[arg(long, value_name = "NS", allow_negative_numbers = true)]
    clock_offset: Option<i64>,
    /// Folder with message definitions, searched first.
    #[arg(long, value_name = "FOLDER")]
    messages: Vec<PathBuf>,
    /// Bytes of the largest sample, which sets the size of socket buffers.
    #[arg(long, value_name = "BYTES")]
    largest: Option<usize>,
    /// Bytes of the preroll; default: the sum of what the lambdas request.
    #[arg(long, value_name = "BYTES")]
    preroll_memory: Option<u64>,
    /// Bytes of the disk to keep free: below, no clip is begun, and an open one ends.
    #[arg(long, value_name = "BYTES", default_value_t = 1 << 30)]
    disk_floor: u64,
    /// Most clips to keep; beyond it, the oldest that were not fetched are deleted.
    #[arg(long, value_name = "N")]
    clips_max: Option<u64>,
    /// Most bytes of clips to keep; beyond it, the oldest that were not fetched are deleted.
    #[arg(long, value_name = "BYTES")]
    bytes_max: Option<u64>,
    /// Topic of commands, of type `std_msgs/msg/String`: any of its writers can request recordings.
    /// Default: none.
    #[arg(long, value_name = "TOPIC")]
    commands: Option<TopicName>,
}

/// The options of the network.
pub(super) struct NetworkOptions(dds::DdsOptions);

impl Args {
    pub(super) fn read(self) -> Result<(RecorderOptions, NetworkOptions), Failure> {
        let usage = |error: &dds::DdsError| {
            Failure::caused_by(Exit::Usage, "cannot use the network", error)
        };
        let mut network =
            self.network.options("/gleaner/recorder").map_err(|error| usage(&error))?;
        network.largest = self.largest.unwrap_or(network.largest);
        network.messages = self.messages;
        network.clock = self.clock_offset.map_or(network.clock, Clock::new);
        let options = RecorderOptions {
            out: self.out,
            clock: network.clock,
            preroll_bytes: self.preroll_memory,
            disk_floor: self.disk_floor,
            clips_max: self.clips_max,
            bytes_max: self.bytes_max,
            commands: self.commands.map(|topic| topic.to_string()),
        };
        Ok((options, NetworkOptions(network)))
    }
}

impl NetworkOptions {
    pub(super) fn open(self) -> Result<Box<dyn LiveSource>, Failure> {
        let dds = Dds::open(self.0).map_err(|error| {
            Failure::caused_by(Exit::Unreachable, "cannot join the network", &error)
        })?;
        Ok(Box::new(dds))
    }
}
