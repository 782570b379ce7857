//! The sandbox of the process that runs models: files of models are input from untrusted peers, and
//! the libraries that run them are large.
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
/// processes, signals to others, and sockets, but for those that CUDA needs if the process
/// `has_gpu`. New threads are allowed. Returns `layers` and these, verified.
///
/// # Errors
///
/// [`JailError::ExistingThread`] if a thread of this process cannot have the filter: then the
/// sandbox does not hold, and no lambda may be served.
pub fn close(mut layers: Vec<Layer>, has_gpu: bool) -> Result<Vec<Layer>, JailError> {
    let note = match has_gpu {
        true => "seccomp: no new sockets but one that CUDA listens on, no connections",
        false => "seccomp: no new sockets, no connections",
    };
    layers.extend(service_layers(install(has_gpu), (sockets::NAME, note))?);
    Ok(self_test::verify(layers))
}

fn install(has_gpu: bool) -> Result<(), JailError> {
    // It sends regions to lambdas.
    let no_sockets = if has_gpu { sockets::local_listeners_only } else { sockets::no_new };
    let denied = no_sockets(DeniedCalls::default());
    install_everywhere(&sandbox_filter::own_process_only(denied).filter(libc::EPERM)?)
}
