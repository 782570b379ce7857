//! Whether a layer holds, found out by trying what it should refuse.

use std::fs::File;
use std::io;
use std::net::UdpSocket;
use std::os::fd::AsFd;
use std::process::Command;

use gleaner_protocol::{Holds, Layer};

use crate::{alone, files, never};

/// Tries what each of `layers` should refuse to this process, and says of those that did not refuse
/// it that they do not hold.
pub fn tried(mut layers: Vec<Layer>) -> Vec<Layer> {
    for layer in &mut layers {
        if layer.holds == Holds::No {
            continue;
        }
        let refused = match layer.name.as_str() {
            files::NAME => refused(&File::open("/etc/passwd")),
            alone::SOCKETS => refused(&UdpSocket::bind("127.0.0.1:0")),
            alone::PROCESSES => refused(&Command::new("/bin/true").spawn()),
            never::NAME => refused(&enter_no_namespace()),
            _ => continue,
        };
        if !refused {
            layer.holds = Holds::No;
            layer.note = format!("was set up ({}), and does not hold", layer.note);
        }
    }
    layers
}

/// Asks for the namespace that a file stands for, of one that stands for none: without the filter
/// that is said to be no use.
fn enter_no_namespace() -> io::Result<()> {
    let nothing = File::open("/dev/null")?;
    Ok(rustix::thread::move_into_link_name_space(nothing.as_fd(), None)?)
}

fn refused<T>(result: &io::Result<T>) -> bool {
    result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied)
}
