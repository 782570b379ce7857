//! The ingress: receives every topic once, writes each sample once into sealed shared memory, and
//! shares it with all readers on this machine.
//!
//! - `engine`: the loop: one thread that owns the source, the readers and the topics.
//! - `reader`, `publish_rate`: a connected reader, and the limit of what it may publish.
//! - `topics`, `topic`: the topics that have readers, and their subscriptions.
//! - `rate_watch`: notices a topic that receives far fewer samples than before.
//! - `sink`, `sizes`: the memory of a topic, which the thread of the source writes.
//! - [`program`]: the program `gleaner-ingress`.
//!
//! A reader is an untrusted peer: nothing here waits for one, trusts a value that one can write, or
//! opens a file for one. A sample is never copied for a reader.

mod engine;
pub mod program;
mod publish_rate;
mod rate_watch;
mod reader;
mod sink;
mod sizes;
mod topic;
mod topics;

use std::io;
use std::thread::{Builder, JoinHandle};

use gleaner_messages::transport::LiveSource;
use gleaner_protocol::ingress::{IngressControl, IngressReport, IngressServer};

pub use engine::{Ingress, Reports};

impl Ingress {
    /// Starts an ingress in a thread of this process, for tests. It ends when the control
    /// connection is dropped.
    ///
    /// # Panics
    ///
    /// If the system has no thread or no socket left.
    pub fn start_in_thread(source: Box<dyn LiveSource>) -> (IngressControl, JoinHandle<()>) {
        Self::start_with_reports(source, |_| {}).expect("a thread and a pair of sockets")
    }

    /// Starts an ingress in a thread of this process; `reports` is called in that thread.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn start_with_reports(
        source: Box<dyn LiveSource>,
        reports: impl FnMut(IngressReport) + Send + 'static,
    ) -> io::Result<(IngressControl, JoinHandle<()>)> {
        let (control, server) = IngressControl::pair()?;
        let ingress = Ingress::new(source, Box::new(reports));
        let thread = Builder::new().name("ingress".to_owned()).spawn(move || {
            if let Err(error) = ingress.run(IngressServer::new(server), None) {
                tracing::error!(error = &error as &dyn std::error::Error, "the ingress failed");
            }
        })?;
        Ok((control, thread))
    }
}
