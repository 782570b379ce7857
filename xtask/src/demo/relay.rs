//! Relays of connections into a private network: a Unix socket in a folder belongs to no network,
//! so that one side can listen where the other one cannot connect.
//!
//! The name of each socket is the port that it stands for, which both networks use.

use std::fs;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::thread;

/// Relays what arrives at a socket in `folder` to the port of this network, for each port.
pub(super) fn out_of(folder: &Path, ports: &[u16]) -> io::Result<()> {
    for port in ports.iter().copied() {
        let listener = UnixListener::bind(folder.join(port.to_string()))?;
        serve(
            move || listener.accept().map(|(near, _)| near.into()),
            move || TcpStream::connect(local(port)).map(OwnedFd::from),
        );
    }
    Ok(())
}

/// Relays what arrives at a port of this network to its socket in `folder`, for each socket.
pub(super) fn into(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let socket = entry?.path();
        let name = socket.file_name().and_then(|name| name.to_str());
        let port = name.and_then(|name| name.parse().ok());
        let port = port.ok_or_else(|| io::Error::other("a socket has no port as its name"))?;
        let listener = TcpListener::bind(local(port))?;
        serve(
            move || listener.accept().map(|(near, _)| near.into()),
            move || UnixStream::connect(&socket).map(OwnedFd::from),
        );
    }
    Ok(())
}

fn local(port: u16) -> SocketAddr {
    (Ipv4Addr::LOCALHOST, port).into()
}

/// Connects all that `accept` returns, for as long as the program runs.
fn serve(
    mut accept: impl FnMut() -> io::Result<OwnedFd> + Send + 'static,
    mut connect: impl FnMut() -> io::Result<OwnedFd> + Send + 'static,
) {
    thread::spawn(move || {
        loop {
            // Without the other side, the connection ends at once, as it would without a relay.
            let pair = accept().and_then(|near| Ok((near, connect()?)));
            let _ = pair.and_then(|(near, far)| {
                copy(near.try_clone()?.into(), far.try_clone()?.into());
                copy(far.into(), near.into());
                Ok(())
            });
        }
    });
}

/// Copies one direction of a connection until its end. Reading, writing and the end are the same
/// for sockets of all families.
fn copy(mut from: UnixStream, mut to: UnixStream) {
    thread::spawn(move || {
        let mut buffer = [0; 16 << 10];
        while let Ok(length @ 1..) = from.read(&mut buffer) {
            if to.write_all(&buffer[..length]).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Write);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn a_connection_crosses_both_relays_and_ends_in_each_direction() {
        let folder = TestFolder::new();
        let server = TcpListener::bind(local(0)).unwrap();
        let port = server.local_addr().unwrap().port();
        out_of(folder.root(), &[port]).unwrap();
        // Both networks are one here: the outer half is enough.
        let mut client = UnixStream::connect(folder.path(&port.to_string())).unwrap();
        let (mut served, _) = server.accept().unwrap();
        client.write_all(b"question").unwrap();
        client.shutdown(Shutdown::Write).unwrap();
        let mut text = String::new();
        served.read_to_string(&mut text).unwrap();
        assert_eq!(text, "question");
        served.write_all(b"answer").unwrap();
        drop(served);
        text.clear();
        client.read_to_string(&mut text).unwrap();
        assert_eq!(text, "answer");
    }
}
