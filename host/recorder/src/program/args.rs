//! The command line.

use std::path::PathBuf;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_dds as dds;
use gleaner_dds::{Dds, NetworkArgs};
use gleaner_lambda::manifest::TopicName;
use gleaner_transport::{Clock, LiveSource};

use super::RecorderOptions;

/// Records for lambdas from live topics of ROS 2. Lambdas come over standard input, which is a
/// socket of the starter; reports, a JSON object a line, go to standard output.
#[derive(Parser)]
#[command(name = "gleaner-recorder", version)]
pub(super) struct Args {
    /// Folder of the clips: `clips.jsonl`, `clips/`.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    #[command(flatten)]
    network: NetworkArgs,
    /// How far the clock of samples is ahead of CLOCK_MONOTONIC, in ns; without it, it shows the
    /// time of day.
    #[arg(long, value_name = "NS", allow_negative_numbers = true)]
    clock_offset: Option<i64>,
    /// Folder with message definitions, looked through first.
    #[arg(long, value_name = "FOLDER")]
    messages: Vec<PathBuf>,
    /// Bytes of the largest sample, by which socket buffers are sized.
    #[arg(long, value_name = "BYTES")]
    largest: Option<usize>,
    /// Bytes of the preroll; without it, as many as the lambdas ask for together.
    #[arg(long, value_name = "BYTES")]
    preroll_memory: Option<u64>,
    /// Bytes of the disk that stay free: below, no clip is begun, and an open one ends.
    #[arg(long, value_name = "BYTES", default_value_t = 1 << 30)]
    disk_floor: u64,
    /// Most clips that are kept; of more, the oldest that nobody fetched are deleted.
    #[arg(long, value_name = "N")]
    clips_max: Option<u64>,
    /// Most bytes of clips that are kept; of more, the oldest that nobody fetched are deleted.
    #[arg(long, value_name = "BYTES")]
    bytes_max: Option<u64>,
    /// Topic of commands, of type `std_msgs/msg/String`: whoever writes it can have something
    /// recorded. Without it, nobody can.
    #[arg(long, value_name = "TOPIC")]
    commands: Option<TopicName>,
}

/// How the network is joined.
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
