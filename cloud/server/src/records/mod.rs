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

pub(crate) use files::ChunkFiles;
pub(crate) use packing::keep;
pub(crate) use search::{RecordLevel, RecordSearch};
