//! Memory that one process writes and other processes read in place, and the bells of readers.
//!
//! The writer creates a [`TopicRegion`] for each topic, and a [`ControlRegion`] for each reader. It
//! passes the files of both to the reader, which maps them with [`MappedTopic::open`] and
//! [`ControlRegion::open`]. `gleaner_buffers::shared` has the rules of access to that memory; this
//! module has the mappings.
//!
//! # Protection
//!
//! The file of a topic is sealed before anything else sees it: it neither shrinks, which would end
//! its readers by SIGBUS, nor grows, and after the writer's own mapping no process can map it for
//! writing again, whatever rights it has on the file. A kernel that does not know the seal
//! (`F_SEAL_FUTURE_WRITE`, Linux 5.1) refuses it, and then there is no region.
//!
//! A control page is shared by its reader and the writer, which both write it; only its size is
//! sealed.

mod control;
mod futex;
mod topic;

pub use control::ControlRegion;
pub use futex::KernelFutex;
pub use topic::{MappedTopic, TopicRegion};
