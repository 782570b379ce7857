//! Samples in shared memory, which the ingress writes and other processes read in place.
//!
//! [`regions`] is that memory, for both sides. The rest is the reader's end of the ingress: it
//! attaches granted topics, waits for their samples, and publishes.
//!
//! A process has one [`Feed`], over the socket that its starter passed to it. The starter granted
//! the topics; the process receives each of them as a [`SharedTopicReader`], whose samples it reads
//! in place. [`Waker`] wakes it for samples of topics that are granted with `wakes`.
//!
//! ```no_run
//! # fn run(socket: std::os::fd::OwnedFd) -> Result<(), gleaner_samples::FeedError> {
//! use std::time::Duration;
//!
//! use gleaner_samples::Feed;
//!
//! let mut feed = Feed::connect(socket)?;
//! let imu = feed.topic(0, Duration::from_secs(10))?;
//! let mut bell = feed.bell();
//! let mut next = imu.info.first;
//! loop {
//!     // Before the look at the topics, so that a sample after it ends the wait.
//!     let seen = bell.value();
//!     while let Ok(Some(sample)) = imu.reader.get(next) {
//!         println!("{} bytes", sample.len());
//!         next += 1;
//!     }
//!     // It fails once the ingress has ended.
//!     feed.poll()?;
//!     bell.wait(seen, Duration::from_millis(100));
//! }
//! # }
//! ```
//!
//! # Restarts
//!
//! An ingress that ends takes nothing with it: topics and held samples stay valid. A
//! [`ReconnectingReader`] joins the next one, over the socket of the starter, and counts what was
//! lost meanwhile.
//!
//! # Trust
//!
//! The ingress parses what untrusted peers send, so a reader checks what it receives: sizes and
//! seals of memory, and that no two topics share words of the control page. An ingress that breaks
//! the rules can still change the bytes of samples; it cannot make this process read outside of its
//! mappings. It also sends no more than one descriptor with a message; further ones are closed.
//!
//! # Sandboxes
//!
//! Nothing here opens a file or a socket. After [`Feed::connect`], a process needs these calls:
//! `recvmsg`, `send` and `poll` of the open socket, `futex` for the bell, and for each topic that
//! is attached later, and for the page of a later ingress, `fstat`, `fcntl(F_GET_SEALS)`, `mmap` of
//! the received file, and `close`. It never calls `sendmsg`.

mod error;
mod feed;
mod losses;
mod reconnecting;
pub mod regions;
mod starter;
mod topic;
mod waker;

pub use error::FeedError;
pub use feed::{Feed, FeedEvent};
pub use reconnecting::ReconnectingReader;
pub use topic::SharedTopicReader;
pub use waker::Waker;
