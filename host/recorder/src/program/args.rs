//! Parses the command line.

use std::path::PathBuf;

use clap::Parser;
use gleaner_lambda::manifest::TopicName;
use gleaner_messages::Sources;
use gleaner_messages::transport::Clock;
use gleaner_trust::VehicleName;

use super::RecorderOptions;

/// Records for lambdas from live topics, which it reads from the ingress. Its standard input is a
/// socket of the starter; reports, one JSON object per line, go to standard output.
#[derive(Parser)]
#[command(name = "gleaner-recorder", version = gleaner_base::version())]
pub struct Args {
    /// Output folder: `clips.jsonl`, `clips/`.
    #[arg(long, value_name = "FOLDER")]
    pub(super) out: PathBuf,
    /// Offset of the sample clock from CLOCK_MONOTONIC, in ns; default: the time of day.
    #[arg(long, value_name = "NS", allow_negative_numbers = true)]
    clock_offset: Option<i64>,
    /// Folder with message definitions, searched first.
    #[arg(long, value_name = "FOLDER")]
    messages: Vec<PathBuf>,
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
    /// Name of the vehicle in the signatures of clips; the starter passes the key. Default: clips
    /// are not signed.
    #[arg(long, value_name = "NAME")]
    pub(super) vehicle_name: Option<VehicleName>,
}

impl Args {
    pub fn read(self) -> RecorderOptions {
        RecorderOptions {
            out: self.out,
            clock: self.clock_offset.map_or_else(Clock::from_time_of_day, Clock::new),
            messages: Sources::new(&self.messages, &installed()),
            preroll_bytes: self.preroll_memory,
            disk_floor: self.disk_floor,
            clips_max: self.clips_max,
            bytes_max: self.bytes_max,
            commands: self.commands.map(|topic| topic.to_string()),
        }
    }
}

/// Returns the prefixes of the installation of ROS 2.
fn installed() -> Vec<PathBuf> {
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    std::env::split_paths(&prefixes)
        .filter(|path| path.is_absolute() && path.parent().is_some())
        .collect()
}
