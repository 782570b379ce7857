//! Builds RTPS packets, valid and broken. Source: OMG DDSI-RTPS 2.3, sections 8.3.7 and 9.4.5.

use gleaner_test_support::random::XorShift64;

/// Id of an endpoint within a participant.
pub type Entity = [u8; 4];

pub const ANY: Entity = [0; 4];
/// The reader of participants' announcements, which every participant has.
pub const SPDP_READER: Entity = [0, 1, 0, 0xc7];
const SPDP_WRITER: Entity = [0, 1, 0, 0xc2];
const SEDP_WRITERS: Entity = [0, 0, 3, 0xc2];
const SEDP_READERS: Entity = [0, 0, 4, 0xc2];

const HEADER: usize = 20;
const DATA_FRAG: u8 = 0x16;
/// All integers are little-endian.
const LITTLE: u8 = 1;
const HAS_DATA: u8 = 4;

/// A packet from the participant with this prefix.
pub fn packet(prefix: [u8; 12], submessages: &[Vec<u8>]) -> Vec<u8> {
    // Version 2.3, and the vendor id of Cyclone DDS.
    [&b"RTPS\x02\x03\x01\x10"[..], &prefix, &submessages.concat()].concat()
}

fn submessage(kind: u8, flags: u8, parts: &[&[u8]]) -> Vec<u8> {
    let body = parts.concat();
    let length = (body.len() as u16).to_le_bytes();
    [&[kind, LITTLE | flags][..], &length, &body].concat()
}

fn number(seq: u64) -> [u8; 8] {
    let (high, low) = (((seq >> 32) as u32).to_le_bytes(), (seq as u32).to_le_bytes());
    [high, low].concat().try_into().expect("two words are eight bytes")
}

fn word(value: u32) -> [u8; 4] {
    value.to_le_bytes()
}

/// A sample, with its encapsulation.
pub fn data(reader: Entity, writer: Entity, seq: u64, payload: &[u8]) -> Vec<u8> {
    submessage(0x15, HAS_DATA, &[&[0, 0, 16, 0], &reader, &writer, &number(seq), payload])
}

/// The first fragment of a sample that claims to have `size` bytes.
pub fn data_frag(reader: Entity, writer: Entity, seq: u64, size: u32, payload: &[u8]) -> Vec<u8> {
    let counts =
        [1_u32.to_le_bytes().as_slice(), &[1, 0], &(payload.len() as u16).to_le_bytes()].concat();
    submessage(
        DATA_FRAG,
        0,
        &[&[0, 0, 28, 0], &reader, &writer, &number(seq), &counts, &word(size), payload],
    )
}

/// A valid packet of each kind, from the writer `writer` of the participant `prefix`.
pub fn valid_packets(prefix: [u8; 12], writer: Entity, cdr: &[u8]) -> Vec<Vec<u8>> {
    let sample = [&[0, 1, 0, 0][..], cdr].concat();
    // A list of parameters: PID_TOPIC_NAME with four characters, then the end.
    let parameters = b"\0\x03\0\0\x05\0\x08\0\x04\0\0\0abc\0\x01\0\0\0";
    let info_ts = || submessage(0x09, 0, &[&word(1), &word(2)]);
    let one = |submessage: Vec<u8>| packet(prefix, &[info_ts(), submessage]);
    vec![
        one(data(ANY, writer, 1_000, &sample)),
        one(data(ANY, writer, u64::MAX >> 1, &sample)),
        // An unknown encapsulation, and none at all.
        one(data(ANY, writer, 1_001, &[0xff, 0xee, 0, 0, 1, 2, 3, 4])),
        one(data(ANY, writer, 1_002, &[])),
        one(data_frag(ANY, writer, 2_000, 4_096, &sample)),
        one(data_frag(SPDP_READER, writer, 2_000, 4_096, &sample)),
        // HEARTBEAT, GAP, ACKNACK, NACK_FRAG, HEARTBEAT_FRAG.
        one(submessage(0x07, 0, &[&ANY, &writer, &number(1), &number(3_000), &word(9)])),
        one(submessage(
            0x08,
            0,
            &[&ANY, &writer, &number(1), &number(40), &word(32), &word(u32::MAX)],
        )),
        one(submessage(0x06, 0, &[&writer, &ANY, &number(1), &word(256), &[0xff; 32], &word(7)])),
        one(submessage(
            0x12,
            0,
            &[&writer, &ANY, &number(1), &word(1), &word(256), &[0xff; 32], &word(7)],
        )),
        one(submessage(0x13, 0, &[&ANY, &writer, &number(1), &word(900), &word(7)])),
        // INFO_SRC, INFO_DST, INFO_REPLY with more locators than the packet has, PAD, an unknown
        // kind.
        one(submessage(0x0c, 0, &[&word(0), &[2, 3, 1, 16], &[0xaa; 12]])),
        one(submessage(0x0e, 0, &[&[0xaa; 12]])),
        one(submessage(0x0f, 0, &[&word(0x0fff_ffff), &[0; 24]])),
        one(submessage(0x01, 0, &[&[0; 8]])),
        one(submessage(0x7f, 0, &[&[0; 8]])),
        // Discovery.
        one(data(ANY, SPDP_WRITER, 1, parameters)),
        one(data(SPDP_READER, SPDP_WRITER, 2, &parameters[..12])),
        one(data(ANY, SEDP_WRITERS, 1, parameters)),
        one(data(ANY, SEDP_READERS, 1, parameters)),
    ]
}

/// Breaks a packet in one of several ways, after the first four bytes: without those it would be
/// ignored.
pub fn broken(packet: &[u8], random: &mut XorShift64) -> Vec<u8> {
    const EXTREMES: [u32; 5] = [0, 1, 0x7fff_ffff, 0x8000_0000, u32::MAX];
    let mut packet = packet.to_vec();
    match random.below(5) {
        0 => {
            for _ in 0..=random.below(8) {
                let at = 4 + random.below(packet.len() - 4);
                packet[at] ^= 1 << random.below(8);
            }
        }
        1 => packet.truncate(4 + random.below(packet.len() - 4)),
        2 => {
            let at = starts(&packet).into_iter().nth(random.below(2)).unwrap_or(HEADER);
            let length = (random.below(0x1_0000) as u16).to_le_bytes();
            packet[at + 2..at + 4].copy_from_slice(&length);
        }
        3 => {
            let words = (packet.len() - HEADER) / 4;
            for _ in 0..=random.below(3) {
                let at = HEADER + 4 * random.below(words);
                packet[at..at + 4].copy_from_slice(&word(EXTREMES[random.below(EXTREMES.len())]));
            }
        }
        _ => packet
            .extend((0..=random.below(200)).map(|_| random.below(256) as u8).collect::<Vec<_>>()),
    }
    packet
}

/// Offsets of the submessages of a packet, by their lengths.
fn starts(packet: &[u8]) -> Vec<usize> {
    let (mut starts, mut at) = (Vec::new(), HEADER);
    while let Some([_, flags, length @ ..]) = packet.get(at..at + 4) {
        starts.push(at);
        let length = [length[0], length[1]];
        let length = if flags & LITTLE == 0 {
            u16::from_be_bytes(length)
        } else {
            u16::from_le_bytes(length)
        };
        at += 4 + usize::from(length);
    }
    starts
}
