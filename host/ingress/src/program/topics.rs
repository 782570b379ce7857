//! `gleaner-ingress topics`: lists the topics of the network.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_dds::{Dds, NetworkArgs};
use gleaner_protocol::ingress::{IngressReport, TopicInfo};
use gleaner_protocol::process_stats::start::stop_socket;
use rustix::process::{Signal, set_parent_process_death_signal};

use super::network::{NetworkError, warn_of_variables};

/// Default time to listen: participants announce themselves every few seconds, and answer a new
/// one at once.
const WAIT_S: f64 = 2.0;
const WAIT_MAX: Duration = Duration::from_secs(3600);

/// Arguments of `topics`.
#[derive(Args, Clone, Debug)]
pub(super) struct TopicsArgs {
    #[command(flatten)]
    network: NetworkArgs,
    /// Time to listen, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = WAIT_S)]
    wait: f64,
}

/// Listens for a while, and reports the topics that were discovered.
pub(super) fn run(args: TopicsArgs, reports: &mut impl Write) -> Result<(), Failure> {
    let wait = Duration::try_from_secs_f64(args.wait).ok().filter(|wait| *wait <= WAIT_MAX);
    let wait = wait.ok_or_else(|| {
        Failure::new(Exit::Usage, format!("--wait {}: use 0 to 3600 s", args.wait))
    })?;
    warn_of_variables();
    let mut options = args.network.options("/gleaner/topics").map_err(NetworkError::failure)?;
    // Others keep a participant that was killed until its lease ends: each signal, and the end of
    // the starter, only end the wait.
    let mut stop = stop_socket()
        .and_then(|stop| {
            set_parent_process_death_signal(Some(Signal::TERM))?;
            let stop = UnixStream::from(stop);
            stop.set_read_timeout(Some(wait.max(Duration::from_millis(1)))).map(|()| stop)
        })
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot handle signals", &error))?;
    // No samples are received.
    options.largest = 0;
    let dds = Dds::open(options).map_err(NetworkError::failure)?;
    let _ = stop.read(&mut [0]);
    let seen = dds.discovered().into_iter().map(|topic| TopicInfo {
        topic: topic.topic,
        type_name: topic.type_name,
        writers: topic.writers,
        readers: topic.readers,
        qos: topic.qos,
    });
    let report = IngressReport::Topics { topics: seen.collect() };
    // The reader may have ended.
    let _ = serde_json::to_writer(&mut *reports, &report);
    let _ = reports.write_all(b"\n");
    Ok(())
}
