//! The sandbox of the ingress, which parses everything that the network or a drive contains.
//!
//! It is weaker than that of a lambda's process in one point: the ingress uses UDP.

use gleaner_protocol::Layer;

use crate::filter::{DeniedCalls, install_everywhere};
use crate::sandbox_filter::service_layers;
use crate::{JailError, Paths, base_filter, files, own_memory, sandbox_filter, self_test, sockets};

/// The devices of network interfaces, which `/sys/class/net` links to.
const NETWORK_DEVICES: &str = "/sys/devices";

/// Sockets that the ingress may create after [`close`].
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum NewSockets {
    /// UDP, for DDS.
    Udp,
    /// None: it plays a drive.
    None,
}

/// Restricts this process, which has one thread, to `paths` and the system's programs and
/// libraries, and hides its memory from other processes. Call it first in `main`: threads that
/// exist already would keep their privileges. One that `has_real_time` priority, since it was
/// requested, keeps it. Returns the layers, for [`close`].
pub fn start(paths: &Paths, has_real_time: bool) -> Vec<Layer> {
    let mut layers = match has_real_time {
        true => base_filter::apply_at_any_priority(),
        false => base_filter::apply(),
    };
    // Each reader and each region has one.
    gleaner_base::raise_open_files();
    layers.push(own_memory::hide());
    let mut paths = paths.clone();
    paths.read.push(NETWORK_DEVICES.into());
    layers.push(files::confine_program(&paths));
    layers
}

/// Denies all threads what the ingress does not need once it has joined the network or opened its
/// drive: programs, processes, signals to others, and sockets but `sockets`. Returns `layers` and
/// these, verified.
///
/// # Errors
///
/// [`JailError::ExistingThread`] if a thread of this process cannot have the filter: then the
/// sandbox does not hold, and no reader may be served.
pub fn close(mut layers: Vec<Layer>, sockets: NewSockets) -> Result<Vec<Layer>, JailError> {
    let denied = match sockets {
        NewSockets::Udp => sockets::udp_only(DeniedCalls::default()),
        // The ingress sends files to its readers.
        NewSockets::None => sockets::no_new(DeniedCalls::default()),
    };
    let (name, note) = match sockets {
        NewSockets::Udp => (sockets::UDP_ONLY, "seccomp: no new sockets but UDP"),
        NewSockets::None => (sockets::NAME, "seccomp: no new sockets, no connections"),
    };
    layers.extend(service_layers(install(denied), (name, note))?);
    Ok(self_test::verify(layers))
}

fn install(denied: DeniedCalls) -> Result<(), JailError> {
    // A socket of DDS gets its options through a copy, which needs a handle of this process.
    let own_handle_only = denied.unless(libc::SYS_pidfd_open, 0, u64::from(std::process::id()));
    install_everywhere(&sandbox_filter::own_process_only(own_handle_only).filter(libc::EPERM)?)
}
