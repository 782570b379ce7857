//! Announces the end of the participant of an ingress that may have been unable to do so itself.
//!
//! A participant that was killed stays matched in other nodes until its lease ends, 50 s later with
//! RustDDS. Until then, a reliable writer that keeps all samples waits for it: one on Cyclone DDS
//! fails after 10 s, one on Fast DDS refuses samples. A single datagram makes both forget it.
//!
//! It is sent after each end, as that of an ingress which ended in order may have been lost.

use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};

use gleaner_protocol::ingress::{DISCOVERY_GROUP, JoinedParticipant};

/// Copies that are sent, as one may be lost.
const COPIES: usize = 3;
/// Participants of this machine to which it is also sent directly, as it may have no multicast.
/// Their ports follow that of the group by ten and more (RTPS 2.5, 9.6.2.3).
const PARTICIPANTS: u16 = 12;
/// Higher than any that RustDDS uses: it announces a participant every 10 s.
const SEQUENCE_NUMBER: u32 = 0x7fff_ffff;

/// Announces that the participant has left. An interface that is gone is left out.
pub(crate) fn send(joined: &JoinedParticipant) {
    let datagram = dispose(joined.prefix);
    let send = |from: Ipv4Addr, to: SocketAddrV4| {
        // Linux sends multicast by the interface of the address that a socket is bound to.
        let Ok(socket) = UdpSocket::bind((from, 0)) else { return };
        for _ in 0..COPIES {
            drop(socket.send_to(&datagram, to));
        }
    };
    for address in &joined.addresses {
        send(*address, SocketAddrV4::new(DISCOVERY_GROUP, joined.port));
    }
    for index in 0..PARTICIPANTS {
        let port = joined.port.saturating_add(10 + 2 * index);
        send(Ipv4Addr::LOCALHOST, SocketAddrV4::new(Ipv4Addr::LOCALHOST, port));
    }
}

/// Returns the datagram by which a participant leaves: RTPS 2.5, 8.3.8.2 and 9.4.5.4.
fn dispose(prefix: [u8; 12]) -> Vec<u8> {
    [
        // Protocol 2.3, and the vendor id of RustDDS.
        &b"RTPS\x02\x03\x01\x12"[..],
        &prefix,
        // DATA, little-endian, with inline QoS and no payload, of 52 bytes.
        &[0x15, 0x03, 52, 0],
        // The inline QoS begins 16 bytes after these four.
        &[0, 0, 16, 0],
        // From the writer of participants to any reader.
        &[0, 0, 0, 0, 0x00, 0x01, 0x00, 0xc2],
        // The upper half of the sequence number comes first.
        &[0; 4],
        &SEQUENCE_NUMBER.to_le_bytes(),
        // PID_KEY_HASH: the GUID of the participant.
        &[0x70, 0, 16, 0],
        &prefix,
        &[0x00, 0x00, 0x01, 0xc1],
        // PID_STATUS_INFO, always big-endian: disposed and unregistered.
        &[0x71, 0, 4, 0, 0, 0, 0, 3],
        // The end of the inline QoS.
        &[1, 0, 0, 0],
    ]
    .concat()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use gleaner_base::hex;

    use super::*;

    /// This datagram made Fast DDS 2.9.1 and Cyclone DDS 0.10.2 forget a killed participant.
    #[test]
    fn each_participant_of_the_machine_receives_the_dispose() {
        let prefix = [1, 0x12, 0xe3, 0xb2, 0x78, 0xb1, 0xd7, 0xe0, 0xdc, 0x75, 0x36, 0x65];
        let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
        receiver.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let port = receiver.local_addr().unwrap().port() - 10;
        send(&JoinedParticipant { prefix, port, addresses: Vec::new() });
        let mut bytes = [0; 100];
        let length = receiver.recv(&mut bytes).unwrap();
        let expected = "52545053020301120112e3b278b1d7e0dc753665\
                        150334000000100000000000000100c200000000ffffff7f\
                        700010000112e3b278b1d7e0dc753665000001c1\
                        710004000000000301000000";
        assert_eq!(hex(&bytes[..length]), expected);
    }
}
