//! Support for the tests of several crates. Components use [`operations`], so this crate needs no
//! other of the workspace.

#[cfg(feature = "cloud")]
pub mod cloud;
#[cfg(feature = "drives")]
pub mod drives;
#[cfg(unix)]
mod folder;
#[cfg(feature = "network-namespace")]
pub mod network_namespace;
#[cfg(feature = "onnx")]
pub mod onnx;
pub mod operations;
pub mod random;
mod shared_data;
#[cfg(feature = "spool")]
pub mod simulated_disk;

#[cfg(unix)]
pub use folder::TestFolder;
pub use shared_data::shared_file;
