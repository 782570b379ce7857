//! Records of vehicles across rows of the database and chunks: files in the folder or the bucket,
//! each with many old records of a stream.
//!
//! `chunk` has the format of a chunk, and `files` its file. `packing` moves old records into chunks
//! and removes what is too old; all replicas do so. `reading` returns records in the order of their
//! arrival, `newest` from the newest on, and `search` those that match. Readers in other
//! rooms see one sequence, and no chunk.

mod chunk;
mod files;
mod newest;
mod packing;
mod reading;
mod search;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use crate::store::CloudStore;

pub(crate) use files::ChunkFiles;
pub(crate) use packing::keep;
pub(crate) use search::{RecordLevel, RecordSearch};

/// All records of vehicles, in rows and in chunks.
pub(crate) struct RecordArchive {
    store: Arc<CloudStore>,
    chunks: ChunkFiles,
    /// Days for which records are kept at least; 0 is without an end.
    keep_days: u32,
}

impl RecordArchive {
    pub(crate) fn new(store: &Arc<CloudStore>, chunks: ChunkFiles, keep_days: u32) -> Self {
        Self { store: Arc::clone(store), chunks, keep_days }
    }
}
