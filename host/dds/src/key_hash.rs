//! Adds the key hash to the disposes of RustDDS: without it, Fast DDS ignores them.
//!
//! RustDDS announces the end of a reader, a writer or a participant by a DATA submessage with the
//! key as its payload, a list with the GUID, of 28 bytes. Fast DDS reads keys of up to 16 bytes
//! only: the endpoint stays matched until the lease of the participant ends, 50 s after the
//! process. With PID_KEY_HASH in the inline QoS (RTPS 2.5, 9.6.4.8), which is the GUID itself here,
//! Fast DDS forgets it at once. Other implementations read either.
//!
//! These submessages are numbered and sent again, so a second one beside that of RustDDS would take
//! the number of the next announcement. The hash is added where a datagram is sent, by `sendto` of
//! libc: as in `joins`, the function is replaced for the whole program, and sends everything else
//! as it is. To be deleted once RustDDS adds the hash, see `docs/dds-limits.md`.

#![allow(unsafe_code)]

use std::ffi::{c_int, c_void};
use std::slice;

/// Bytes of the header of a datagram.
const HEADER: usize = 20;
/// DATA, little-endian, with inline QoS, with a key instead of data, of 60 bytes.
const BEGIN: [u8; 8] = [0x15, 0x0b, 60, 0, 0, 0, 16, 0];
/// The inline QoS, in bytes from the start of the submessage: PID_STATUS_INFO (disposed and
/// unregistered) and the end. Then the payload: PL_CDR_LE, and a parameter of 16 bytes, the GUID.
const QOS_AT: usize = 24;
const QOS: [u8; 16] = [0x71, 0, 4, 0, 0, 0, 0, 3, 1, 0, 0, 0, 0, 3, 0, 0];
const GUID_AT: usize = QOS_AT + QOS.len() + 4;
/// Length without the header of four bytes, and PID_KEY_HASH with 16 bytes.
const CHANGED_LENGTH: [u8; 2] = [80, 0];
const KEY_HASH: [u8; 4] = [0x70, 0, 16, 0];

/// Returns the GUID of a dispose without a key hash; `None` for any other submessage.
fn disposed(submessage: &[u8]) -> Option<&[u8]> {
    let is_it = submessage.len() == 64
        && submessage.starts_with(&BEGIN)
        // Built-in writers with a key have this kind, the last byte of their ids.
        && submessage[15] == 0xc2
        && submessage[QOS_AT..].starts_with(&QOS)
        && submessage[GUID_AT - 2..].starts_with(&[16, 0]);
    is_it.then(|| &submessage[GUID_AT..GUID_AT + 16])
}

/// Returns the datagram with a key hash in each dispose; `None`, and nothing is copied, if it has
/// none that lacks it.
fn with_key_hashes(datagram: &[u8]) -> Option<Vec<u8>> {
    if !datagram.starts_with(b"RTPS") {
        return None;
    }
    let (mut changed, mut copied, mut at) = (Vec::new(), 0, HEADER);
    while let Some([_, _, low, high]) = datagram.get(at..at + 4) {
        let end = at + 4 + usize::from(u16::from_le_bytes([*low, *high]));
        let Some(submessage) = datagram.get(at..end) else { break };
        if let Some(guid) = disposed(submessage) {
            let (begin, qos) = (&submessage[4..QOS_AT], &submessage[QOS_AT..]);
            let before = &datagram[copied..at];
            let parts = [before, &BEGIN[..2], &CHANGED_LENGTH, begin, &KEY_HASH, guid, qos];
            changed.extend(parts.concat());
            copied = end;
        }
        at = end;
    }
    changed.extend_from_slice(datagram.get(copied..).filter(|_| copied > 0)?);
    Some(changed)
}

/// Replaces libc's function of this name.
///
/// # Safety
///
/// As for libc's: `bytes` points to `length` bytes, and `address` to `address_length`.
// SAFETY: name and signature are libc's, and so is what it does, but for the bytes that it sends.
#[unsafe(no_mangle)]
unsafe extern "C" fn sendto(
    socket: c_int,
    bytes: *const c_void,
    length: libc::size_t,
    flags: c_int,
    address: *const libc::sockaddr,
    address_length: libc::socklen_t,
) -> libc::ssize_t {
    let changed = (length > HEADER && !bytes.is_null()).then(|| {
        // SAFETY: they are readable, as the caller of this function promises.
        with_key_hashes(unsafe { slice::from_raw_parts(bytes.cast::<u8>(), length) })
    });
    let changed = changed.flatten();
    let (from, count) = match &changed {
        Some(changed) => (changed.as_ptr().cast(), changed.len()),
        None => (bytes, length),
    };
    // SAFETY: the arguments are those of the system call; `from` points to `count` bytes, and
    // `address` is as the caller of this function promises.
    let sent = unsafe {
        libc::syscall(libc::SYS_sendto, socket, from, count, flags, address, address_length)
    };
    match changed {
        // The caller knows the length of its own datagram.
        Some(_) if sent >= 0 => length.cast_signed(),
        _ => isize::try_from(sent).unwrap_or(-1),
    }
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::*;

    const GUID: [u8; 16] = [1, 0x12, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0, 0, 2, 4];
    /// INFO_TS, and a HEARTBEAT.
    const TIME: [u8; 12] = [9, 1, 8, 0, 1, 2, 3, 4, 5, 6, 7, 8];
    const HEARTBEAT: [u8; 8] = [7, 1, 4, 0, 0, 0, 0, 0];

    /// The end of a reader, as RustDDS 0.15.1 sends it, or with the bytes that are missing in it.
    fn dispose(length: u8, hash: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0x15, 0x0b, length, 0, 0, 0, 16, 0, 0, 0, 4, 0xc7, 0, 0, 4, 0xc2];
        bytes.extend([0, 0, 0, 0, 5, 0, 0, 0]);
        bytes.extend(hash);
        bytes.extend([0x71, 0, 4, 0, 0, 0, 0, 3, 1, 0, 0, 0, 0, 3, 0, 0, 0x5a, 0, 16, 0]);
        bytes.extend(GUID);
        bytes.extend([1, 0, 0, 0]);
        bytes
    }

    fn datagram(submessages: &[&[u8]]) -> Vec<u8> {
        [b"RTPS\x02\x03\x01\x12", &GUID[..12], &submessages.concat()].concat()
    }

    #[test]
    fn a_dispose_gets_its_key_hash_and_all_else_is_sent_as_it_is() {
        let hash = [&[0x70, 0, 16, 0], &GUID[..]].concat();
        let (without, with) = (dispose(60, &[]), dispose(80, &hash));
        let sent = datagram(&[&TIME, &without, &HEARTBEAT, &without]);
        let expected = datagram(&[&TIME, &with, &HEARTBEAT, &with]);
        assert_eq!(with_key_hashes(&sent).as_ref(), Some(&expected));
        assert_eq!(with_key_hashes(&expected), None, "they have it");
        let [one, other] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        assert_eq!(one.send_to(&sent, other.local_addr().unwrap()).unwrap(), sent.len());
        let mut received = [0; 400];
        let length = other.recv(&mut received).unwrap();
        assert_eq!(received[..length], expected[..]);
        let mut sample = without.clone();
        sample[15] = 3;
        let whole = datagram(&[&without]);
        let cut = &whole[..whole.len() - 1];
        for unchanged in [&datagram(&[&TIME, &HEARTBEAT, &sample]), cut, &whole[..22], b"?", &[]] {
            assert_eq!(with_key_hashes(unchanged), None, "{unchanged:?}");
        }
    }
}
