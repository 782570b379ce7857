//! The sandbox of the recorder, which reads samples and messages of lambdas, and writes clips.

use std::path::PathBuf;

use gleaner_protocol::Layer;

use crate::filter::{DeniedCalls, install};
use crate::sandbox_filter::{self, PROCESSES};
use crate::{JailError, base_filter, files, own_memory, self_test, sockets};

/// Restricts this process, which has one thread: it can change only `paths`, creates no sockets,
/// programs or processes, and sends no signals to others. Call it first in `main`, with the output
/// folder, which exists. Files that the user can read stay readable: lambdas are anywhere, and are
/// announced later. Returns the layers, verified.
pub fn enter(paths: &[PathBuf]) -> Vec<Layer> {
    let mut layers = base_filter::apply();
    layers.push(own_memory::hide());
    layers.push(files::confine_writes(paths));
    layers.extend(match deny() {
        Ok(()) => [
            Layer::yes(sockets::NAME, "seccomp: no new sockets, no connections"),
            Layer::yes(PROCESSES, "seccomp: no new processes, no programs, no signals to others"),
        ],
        Err(error) => [sockets::NAME, PROCESSES].map(|name| Layer::no(name, error.chain())),
    });
    self_test::verify(layers)
}

fn deny() -> Result<(), JailError> {
    let denied = sandbox_filter::no_processes(sockets::none(DeniedCalls::default()));
    install(&sandbox_filter::no_signals(denied).filter(libc::EPERM)?)
}
