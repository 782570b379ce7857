//! Parses the command line.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use gleaner_dds::NetworkArgs;
use gleaner_drives::journals_of;
use gleaner_messages::transport::Clock;
use gleaner_sandbox::Paths;
use gleaner_sandbox::ingress::NewSockets;

use super::topics::TopicsArgs;

/// Receives topics for lambdas and the recorder, and shares each sample with them in memory.
/// Standard input is the socket of a starter; reports, one JSON object per line, go to standard
/// output.
#[derive(Parser)]
#[command(name = "gleaner-ingress", version = gleaner_base::version())]
#[command(args_conflicts_with_subcommands = true)]
pub(super) struct Args {
    #[command(subcommand)]
    pub(super) command: Option<IngressCommand>,
    #[command(flatten)]
    pub(super) network: NetworkArgs,
    /// Name of the node in the ROS 2 graph.
    #[arg(long, value_name = "NAME", default_value = "/gleaner/ingress")]
    pub(super) node: String,
    /// Offset of the sample clock from CLOCK_MONOTONIC, in ns; default: the time of day.
    #[arg(long, value_name = "NS", allow_negative_numbers = true)]
    clock_offset: Option<i64>,
    /// Bytes of the largest sample, which sets the size of socket buffers.
    #[arg(long, value_name = "BYTES")]
    pub(super) largest: Option<usize>,
    /// Receive with real-time priority, if the system permits it.
    #[arg(long, conflicts_with = "drive")]
    pub(super) real_time: bool,
    /// MCAP file, rosbag2 database or directory to play instead of the network; several are played
    /// as one.
    #[arg(long, value_name = "FILE|DIR")]
    pub(super) drive: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives.
    #[arg(long)]
    pub(super) merge: bool,
    /// Speed of the drive: 2 plays it twice as fast as it was recorded.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = rate)]
    pub(super) rate: f64,
    /// Folder for the content of packed files; default: the system's folder for temporary files.
    #[arg(long, value_name = "FOLDER")]
    pub(super) unpack_in: Option<PathBuf>,
}

#[derive(Subcommand)]
pub(super) enum IngressCommand {
    /// Reports the topics of the network, and ends.
    Topics(TopicsArgs),
    /// Asks the system for real-time priority, and ends: with an error if it is refused.
    RealTime,
}

impl Args {
    pub(super) fn clock(&self) -> Clock {
        self.clock_offset.map_or_else(Clock::from_time_of_day, Clock::new)
    }

    pub(super) fn is_of_network(&self) -> bool {
        self.drive.is_empty()
    }

    /// Returns the files that the process needs.
    pub(super) fn paths(&self) -> Paths {
        if self.is_of_network() {
            return Paths::default();
        }
        let unpack_in = self.unpack_in.clone().unwrap_or_else(std::env::temp_dir);
        // Of a database that was not closed, the newest messages are in a file beside it.
        let beside = self.drive.iter().flat_map(|drive| journals_of(drive));
        let read = self.drive.iter().cloned().chain(beside.filter(|journal| journal.is_file()));
        Paths { read: read.collect(), write: vec![unpack_in] }
    }

    /// Returns the sockets that the process may create once it has a source.
    pub(super) fn new_sockets(&self) -> NewSockets {
        if self.is_of_network() { NewSockets::Udp } else { NewSockets::None }
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate: &f64| rate.is_finite() && *rate > 0.0);
    rate.ok_or_else(|| "it is not a number above 0".to_owned())
}
