//! Verifies the layers: tries the actions that each of them should deny.

use std::fs::File;
use std::io;
use std::net::{TcpListener, UdpSocket};
use std::os::fd::AsFd;
use std::os::unix::net::UnixDatagram;
use std::process::Command;

use gleaner_protocol::{Holds, Layer};

use crate::{base_filter, files, sandbox_filter, sockets};

/// Tries in this process what each of `layers` should deny, and marks those that do not as not
/// holding.
pub fn verify(mut layers: Vec<Layer>) -> Vec<Layer> {
    for layer in &mut layers {
        if layer.holds == Holds::No {
            continue;
        }
        let refused = match layer.name.as_str() {
            files::NAME => refused(&File::open("/etc/passwd")),
            files::WRITTEN => refused(&File::options().write(true).open("/dev/full")),
            sockets::NAME => refused(&UdpSocket::bind("127.0.0.1:0")),
            sockets::INTERNET_ONLY => refused(&UnixDatagram::unbound()),
            sockets::UDP_ONLY => refused(&TcpListener::bind("127.0.0.1:0")),
            sandbox_filter::PROCESSES => refused(&Command::new("/bin/true").spawn()),
            base_filter::NAME => refused(&enter_no_namespace()),
            _ => continue,
        };
        if !refused {
            layer.holds = Holds::No;
            layer.note = format!("set up ({}), but does not hold", layer.note);
        }
    }
    layers
}

/// Tries to join the namespace of a file that has none. Without the filter the call fails with
/// another error.
fn enter_no_namespace() -> io::Result<()> {
    let nothing = File::open("/dev/null")?;
    Ok(rustix::thread::move_into_link_name_space(nothing.as_fd(), None)?)
}

fn refused<T>(result: &io::Result<T>) -> bool {
    result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied)
}
