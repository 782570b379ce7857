//! Keeps RustDDS from announcing a multicast address for samples: Fast DDS aborts when two of our
//! readers have the same one.
//!
//! RustDDS announces the address when a socket could join its group, and has no option against
//! that. Fast DDS 2.9.0 to 2.10.6, 2.11.0 to 2.14.4 and 3.0.0 to 3.1.2 records the addresses to
//! which a writer sends to all of its readers together: the multicast address, once two readers
//! share it. The first HEARTBEAT goes to the second reader alone, at an address that is not
//! recorded: an assertion fails (`OutputTrafficManager::set_statistics_message_data`), or memory
//! beyond a list is changed in builds without assertions. The address of a reader without multicast
//! is always recorded.
//!
//! So the join is made to fail, as it does on an interface without multicast. A seccomp filter sees
//! no ports, and without the join of discovery RustDDS would not announce itself by multicast
//! either. Binding the port would keep other programs from it. What remains is libc's `setsockopt`,
//! with which the join is made: it is replaced for the whole program by a function that refuses
//! this one join while a [`NoJoin`] lives on the thread, and passes on everything else. To be
//! deleted once RustDDS has an option.

#![allow(unsafe_code)]

use std::cell::Cell;
use std::ffi::{c_int, c_void};
use std::marker::PhantomData;
use std::net::SocketAddrV4;
use std::os::fd::BorrowedFd;

use nix::errno::Errno;
use socket2::SockRef;

thread_local! {
    /// The port at which sockets join no group; 0 for none. It has no destructor, so it can be read
    /// as long as the thread runs.
    static REFUSED: Cell<u16> = const { Cell::new(0) };
}

/// While it lives, sockets at one port join no multicast group on this thread.
pub(super) struct NoJoin(PhantomData<*const ()>);

impl NoJoin {
    pub(super) fn at(port: u16) -> Self {
        REFUSED.set(port);
        Self(PhantomData)
    }
}

impl Drop for NoJoin {
    fn drop(&mut self) {
        REFUSED.set(0);
    }
}

/// Replaces libc's function of this name.
///
/// # Safety
///
/// As for libc's: `value` points to `length` bytes.
// SAFETY: name and signature are libc's, and so is what it does, with one more error that it may
// return.
#[unsafe(no_mangle)]
unsafe extern "C" fn setsockopt(
    socket: c_int,
    level: c_int,
    name: c_int,
    value: *const c_void,
    length: libc::socklen_t,
) -> c_int {
    if (level, name) == (libc::IPPROTO_IP, libc::IP_ADD_MEMBERSHIP) && is_refused(socket) {
        Errno::EPERM.set();
        return -1;
    }
    // SAFETY: the arguments are those of the system call; `value` is as the caller of this function
    // promises.
    let answer = unsafe { libc::syscall(libc::SYS_setsockopt, socket, level, name, value, length) };
    if answer < 0 { -1 } else { 0 }
}

/// Returns whether the socket is to join no group. Then it receives from none.
fn is_refused(socket: c_int) -> bool {
    let refused = REFUSED.get();
    if refused == 0 || socket < 0 {
        return false;
    }
    // SAFETY: it is not -1, and is only passed to the kernel, which returns an error if it is not
    // open.
    let socket = unsafe { BorrowedFd::borrow_raw(socket) };
    let here =
        rustix::net::getsockname(socket).ok().and_then(|here| SocketAddrV4::try_from(here).ok());
    let is_refused = here.is_some_and(|here| here.port() == refused);
    if is_refused {
        // Otherwise Linux delivers datagrams of groups that any socket of the machine has joined. A
        // writer sends by multicast to readers with multicast and by unicast to us: each fragment
        // would arrive twice, and a fragment that arrives after its sample is complete takes as
        // much memory as the whole sample. This call fails on no IPv4 socket.
        let _ = SockRef::from(&socket).set_multicast_all_v4(false);
    }
    is_refused
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;
    use std::net::{Ipv4Addr, UdpSocket};
    use std::thread;

    use super::*;

    const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

    fn join(socket: &UdpSocket) -> std::io::Result<()> {
        socket.join_multicast_v4(&GROUP, &Ipv4Addr::LOCALHOST)
    }

    #[test]
    fn sockets_at_the_port_join_no_group_on_this_thread_while_the_guard_lives() {
        let [one, other] = [(); 2].map(|()| UdpSocket::bind("0.0.0.0:0").unwrap());
        let no_join = NoJoin::at(one.local_addr().unwrap().port());
        assert_eq!(join(&one).unwrap_err().kind(), ErrorKind::PermissionDenied);
        join(&other).unwrap();
        assert_eq!(
            [&one, &other].map(|socket| SockRef::from(socket).multicast_all_v4().unwrap()),
            [false, true]
        );
        thread::scope(|scope| scope.spawn(|| join(&one)).join().unwrap()).unwrap();
        one.leave_multicast_v4(&GROUP, &Ipv4Addr::LOCALHOST).unwrap();
        drop(no_join);
        join(&one).unwrap();
    }
}
