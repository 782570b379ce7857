//! The sandbox of the process that runs models: files of models are input from strangers, and the
//! libraries that run them are large.
//!
//! It receives all files over its sockets, and creates memory that it shares with lambdas.

use gleaner_protocol::Layer;

use crate::filter::{DeniedCalls, install_everywhere};
use crate::sandbox_filter::service_layers;
use crate::{JailError, Paths, base_filter, files, own_memory, sandbox_filter, self_test, sockets};

/// Restricts this process, which has one thread, to `paths` and the system's programs and
/// libraries, and hides its memory from other processes. Call it first in `main`: threads that
/// exist already would keep their privileges. Returns the layers, for [`close`].
pub fn start(paths: &Paths) -> Vec<Layer> {
    let mut layers = base_filter::apply();
    // Each lambda has a socket and two regions.
    gleaner_base::raise_open_files();
    layers.push(own_memory::hide());
    layers.push(files::confine_program(paths));
    layers
}

/// Denies all threads what the process does not need once its libraries are open: programs,
/// processes, signals to others, and sockets. New threads are allowed. Returns `layers` and these,
/// verified.
///
/// # Errors
///
/// [`JailError::ExistingThread`] if a thread of this process cannot have the filter: then the
/// sandbox does not hold, and no lambda may be served.
pub fn close(mut layers: Vec<Layer>) -> Result<Vec<Layer>, JailError> {
    let sockets = (sockets::NAME, "seccomp: no new sockets, no connections");
    layers.extend(service_layers(install(), sockets)?);
    Ok(self_test::verify(layers))
}

fn install() -> Result<(), JailError> {
    // It sends regions to lambdas.
    let denied = sockets::no_new(DeniedCalls::default());
    install_everywhere(&sandbox_filter::own_process_only(denied).filter(libc::EPERM)?)
}
