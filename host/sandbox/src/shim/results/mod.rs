//! Writes the results of a live lambda: its process sends items through a pipe, and a thread of the
//! shim writes them into files or into a spool.
//!
//! Native code of a lambda can write into the pipe as well. So each item is parsed before it is
//! written, has a bounded length, and is counted if it is refused: arbitrary input costs the lambda
//! its own results, and no more than a share of a core.

mod files;
mod item_writer;
mod lines;
mod sink;
mod spool;

use std::io::{self, PipeWriter};
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::mpsc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_protocol::process_stats::Heartbeat;
use rustix::io::ioctl_fionbio;

pub(crate) use self::files::ResultFiles;
use self::item_writer::ItemWriter;
use self::sink::ResultSink;
pub(crate) use self::spool::{BUDGET, ResultSpool};

/// Longest time until the results are open. A spool waits for a lock, and reads its last segment.
const OPEN: Duration = Duration::from_secs(30);

/// A running thread that writes results.
pub(crate) struct Results {
    thread: JoinHandle<Option<ItemWriter>>,
    /// Closed when the runtime has ended.
    runs: PipeWriter,
}

impl Results {
    /// Starts the thread, and waits until it has opened the results in `folder` by `open`, and has
    /// written their first record. Returns the runtime's end of the pipe.
    pub(crate) fn begin<S: ResultSink + 'static>(
        folder: &Path,
        heartbeat: &Heartbeat,
        open: impl FnOnce(&Path) -> Result<S, Failure> + Send + 'static,
    ) -> Result<(Self, PipeWriter), Failure> {
        let cannot =
            |error: io::Error| Failure::caused_by(Exit::Internal, "cannot receive results", &error);
        let (items, runtimes) = io::pipe().map_err(cannot)?;
        // Neither side blocks: a runtime counts the items that do not fit.
        for end in [items.as_fd(), runtimes.as_fd()] {
            ioctl_fionbio(end, true).map_err(|error| cannot(error.into()))?;
        }
        let (ended, runs) = io::pipe().map_err(cannot)?;
        let (opened, outcome) = mpsc::sync_channel(1);
        let (heartbeat, path) = (heartbeat.clone(), folder.to_owned());
        let write = move || {
            let (writer, result) = match open(&path) {
                Ok(sink) => (Some(ItemWriter::new(Box::new(sink), heartbeat)), Ok(())),
                Err(failure) => (None, Err(failure)),
            };
            // It is not received if opening took too long: then the shim is about to end.
            let _ = opened.send(result);
            writer.map(|writer| writer.write(items, &ended))
        };
        let thread = thread::Builder::new().name("gleaner-results".to_owned());
        let thread = thread.spawn(write).map_err(cannot)?;
        outcome.recv_timeout(OPEN).unwrap_or_else(|_| Err(unresponsive(folder)))?;
        Ok((Self { thread, runs }, runtimes))
    }

    /// Waits until all items are read that the runtime left in the pipe when it ended.
    pub(crate) fn end(self) -> ItemWriter {
        drop(self.runs);
        let writer = self.thread.join().expect("writing results does not panic");
        writer.expect("`begin` returned after the results were open")
    }
}

fn unresponsive(folder: &Path) -> Failure {
    let message = format!("cannot open the results in `{}`", folder.display());
    let mut failure = Failure::new(Exit::Internal, message).with_help("check the disk");
    failure.causes = vec![format!("the disk has not responded for {} s", OPEN.as_secs())];
    failure
}
