//! Tests of the packet filter on real sockets.

use std::net::UdpSocket;

use socket2::SockRef;

use super::*;

const FRIEND: Prefix = *b"a friend....";
const STRANGER: Prefix = *b"a stranger..";
const IMAGE: usize = 25 << 20;
/// Submessages of a packet that pass, with few and with many known participants.
const PLAIN: usize = 115;
const CROWDED: usize = 95;

fn packet(prefix: Prefix, submessages: &[Vec<u8>]) -> Vec<u8> {
    [b"RTPS\x02\x03\x01\x10", prefix.as_slice(), &submessages.concat()].concat()
}

fn submessage(little: bool, kind: u8, body: &[u8]) -> Vec<u8> {
    let length = u16::try_from(body.len()).unwrap();
    let length = if little { length.to_le_bytes() } else { length.to_be_bytes() };
    [&[kind, u8::from(little)], length.as_slice(), body].concat()
}

fn fragment_of(little: bool, size: u32, fragment: u16) -> Vec<u8> {
    let mut body = vec![0; 40];
    let (fragment, size) = match little {
        true => (fragment.to_le_bytes(), size.to_le_bytes()),
        false => (fragment.to_be_bytes(), size.to_be_bytes()),
    };
    body[26..28].copy_from_slice(&fragment);
    body[28..32].copy_from_slice(&size);
    submessage(little, 0x16, &body)
}

fn fragment(size: u32) -> Vec<u8> {
    fragment_of(true, size, 1000)
}

/// A HEARTBEAT or a GAP of these numbers.
fn range_of(little: bool, kind: u8, numbers: [i64; 2]) -> Vec<u8> {
    let words = numbers.map(|number| [(number >> 32) as u32, number as u32]);
    let bytes = words
        .as_flattened()
        .iter()
        .flat_map(|word| if little { word.to_le_bytes() } else { word.to_be_bytes() });
    submessage(little, kind, &[vec![0; 8], bytes.collect(), vec![0; 4]].concat())
}

fn stamp() -> Vec<u8> {
    submessage(true, 0x09, &[7; 8])
}

fn data() -> Vec<u8> {
    submessage(true, 0x15, &[0x16; 24])
}

/// The bytes of each packet that the kernel passes; 0 if it drops the packet.
fn through(largest: usize, known: Option<&[Prefix]>, packets: &[Vec<u8>]) -> Vec<usize> {
    let [here, there] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    SockRef::from(&here).attach_filter(&program(largest, known)).unwrap();
    let mut bytes = [0; 65_536];
    let mut passed = |packet: &Vec<u8>| {
        there.send_to(packet, here.local_addr().unwrap()).unwrap();
        // Less than a header passes, and marks that nothing came before it.
        there.send_to(b"!", here.local_addr().unwrap()).unwrap();
        let length = here.recv(&mut bytes).unwrap();
        if length == 1 {
            return 0;
        }
        assert_eq!(bytes[..length], packet[..length]);
        assert_eq!(here.recv(&mut bytes).unwrap(), 1);
        length
    };
    packets.iter().map(&mut passed).collect()
}

fn pass(packets: &[Vec<u8>]) -> Vec<bool> {
    let passed = through(IMAGE, Some(&[STRANGER.map(|byte| byte ^ 1), FRIEND]), packets);
    packets.iter().zip(passed).map(|(packet, length)| length == packet.len()).collect()
}

#[test]
fn a_fragment_that_claims_more_than_the_limit_is_dropped_in_either_byte_order() {
    let claims = [
        1_u32,
        0xffff,
        0x1_0000,
        25 << 20,
        (25 << 20) + 65_536,
        (25 << 20) + 131_072,
        1 << 30,
        u32::MAX,
    ];
    for little in [true, false] {
        let packets = claims.map(|size| packet(FRIEND, &[fragment_of(little, size, 1000)]));
        let expected = [true, true, true, true, true, false, false, false];
        assert_eq!(pass(&packets), expected, "little: {little}");
        let nothing = packet(FRIEND, &[fragment_of(little, 1000, 0)]);
        assert_eq!(pass(&[nothing]), [false], "fragments of no bytes");
    }
}

#[test]
fn every_limit_is_kept() {
    for largest in [0, 1, 65_535, 65_536, 1 << 24, 0x1234_5678, u32::MAX as usize, usize::MAX] {
        let sizes = (0..32).flat_map(|bit| [1_u32 << bit, (1 << bit) - 1, u32::MAX << bit]);
        for little in [true, false] {
            let sizes: Vec<u32> = sizes.clone().collect();
            let packets: Vec<_> =
                sizes.iter().map(|n| packet(FRIEND, &[fragment_of(little, *n, 9)])).collect();
            for (size, passed) in sizes.iter().zip(through(largest, None, &packets)) {
                let (size, largest) = (u64::from(*size), largest as u64);
                let (must, may) = (
                    size <= largest.saturating_add(65_536),
                    size < largest.saturating_add(131_072),
                );
                assert!(
                    if passed > 0 { may } else { !must },
                    "{size} of at most {largest}: {passed}"
                );
            }
        }
    }
}

#[test]
fn a_heartbeat_or_a_gap_of_more_than_a_million_numbers_is_dropped_in_either_byte_order() {
    const HIGH: i64 = 1 << 32;
    let few = [
        [1, 0],
        [7, 7],
        [0x1_0000, 0xffff],
        [1, 1 << 20],
        [HIGH - 9, HIGH - 1],
        [HIGH + 7, HIGH + (1 << 20)],
    ];
    let many = [
        [2, 1 << 21],
        [2, HIGH],
        [HIGH, 2 * HIGH],
        [2, 1 << 40],
        [i64::MAX - 9, i64::MAX],
        [-9, -1],
        [-9, 9],
    ];
    for (little, kind) in [(true, 7), (false, 7), (true, 8), (false, 8)] {
        let of = |numbers| packet(FRIEND, &[range_of(little, kind, numbers)]);
        assert_eq!(pass(&few.map(of)), [true; 6], "little: {little}, kind {kind}");
        assert_eq!(pass(&many.map(of)), [false; 7], "little: {little}, kind {kind}");
        let from_one = pass(&[[1, 1 << 21], [1, 1 << 40], [1, i64::MAX]].map(of));
        assert_eq!(from_one, [kind == 8, kind == 8, false], "little: {little}, kind {kind}");
        let spans = (0..22).flat_map(|bit| {
            [1 << bit, (1 << bit) - 1, 0xf_fff0 + bit, 0x10_fff0 + bit, 0x11_fff0 + bit]
        });
        for first in [2, 0xfffe, 0x1_0000, 0xabc_def0, HIGH + 0xffff] {
            let spans: Vec<i64> = spans.clone().collect();
            let packets: Vec<_> = spans.iter().map(|span| of([first, first + span])).collect();
            for (span, passed) in spans.iter().zip(pass(&packets)) {
                assert!(
                    if passed { *span < 17 << 16 } else { *span > 1 << 20 },
                    "{span} from {first}: {passed}"
                );
            }
        }
    }
}

#[test]
fn fragments_of_strangers_are_dropped_and_their_other_packets_pass() {
    let claims =
        [fragment(1000), [stamp(), fragment(1000)].concat(), [data(), fragment(1000)].concat()];
    let packets = claims.map(|claim| packet(STRANGER, &[claim]));
    assert_eq!(pass(&packets), [false; 3]);
    assert_eq!(pass(&[packet(STRANGER, &[stamp(), data()]), packet(STRANGER, &[])]), [true; 2]);
    // Without a list of participants.
    assert!(through(IMAGE, None, &packets).iter().all(|passed| *passed > 0));
    assert_eq!(through(IMAGE, Some(&[]), &[packet(FRIEND, &[fragment(1000)])]), [0]);
}

#[test]
fn fragments_of_every_listed_participant_pass() {
    let known: Vec<Prefix> = (0..KNOWN as u8).map(|n| [n; 12]).collect();
    let packets: Vec<_> = known.iter().map(|prefix| packet(*prefix, &[fragment(1000)])).collect();
    assert!(through(IMAGE, Some(&known), &packets).iter().all(|passed| *passed > 0));
    let like_one = packet([&[5; 11][..], &[6]].concat().try_into().unwrap(), &[fragment(1000)]);
    assert_eq!(through(IMAGE, Some(&known), &[like_one]), [0]);
}

#[test]
fn a_claim_is_found_wherever_it_hides() {
    let evils =
        [fragment(u32::MAX), range_of(true, 7, [1, 1 << 40]), range_of(true, 8, [2, 1 << 40])];
    let pad = submessage(true, 1, &[]);
    let empty_stamp = vec![0x09, 3, 0, 0];
    let beat = range_of(true, 7, [1, 9]);
    let fronts = [
        vec![],
        stamp(),
        data(),
        pad,
        empty_stamp,
        fragment(1000),
        beat,
        [stamp(), stamp(), data()].concat(),
    ];
    for (front, evil) in fronts.iter().flat_map(|front| evils.iter().map(move |evil| (front, evil)))
    {
        for repeat in [1, 2, 3, 4, 5, 6, 9, 30, 99] {
            let hidden = packet(FRIEND, &[front.repeat(repeat), evil.clone()]);
            let passed = through(IMAGE, None, std::slice::from_ref(&hidden))[0];
            assert!(passed <= hidden.len() - evil.len(), "{repeat} of {front:?}, then {evil:?}");
        }
    }
    let mut endless = evils.clone();
    endless.iter_mut().for_each(|evil| evil[2..4].fill(0));
    assert_eq!(pass(&endless.map(|evil| packet(FRIEND, &[evil]))), [false; 3]);
    let in_big_endian = [submessage(true, 1, &[]), fragment_of(false, u32::MAX, 1000)].concat();
    let another = [submessage(true, 0x0c, &[0; 20]), fragment(1000)].concat();
    assert_eq!(pass(&[in_big_endian, another].map(|evil| packet(FRIEND, &[evil]))), [false; 2]);
}

#[test]
fn ordinary_packets_pass_whole() {
    let mut last = data();
    last[2..4].fill(0);
    let beat = || range_of(true, 7, [1, 9]);
    let dense: Vec<_> =
        (0..47).flat_map(|_| [stamp(), fragment(6 << 20)]).chain([data(), beat()]).collect();
    let pairs = [stamp(), data()].concat().repeat(PLAIN);
    let answer = [beat(), range_of(true, 8, [1, 1 << 30]), data()].concat().repeat(6);
    let big_endian: Vec<_> = (0..15).map(|_| fragment_of(false, 6 << 20, 1000)).collect();
    let empty_stamps = [vec![9, 3, 0, 0], data()].concat().repeat(5);
    let contents =
        [dense, vec![pairs], vec![answer], big_endian, vec![empty_stamps], vec![last], vec![]];
    assert_eq!(pass(&contents.map(|content| packet(FRIEND, &content))), [true; 7]);
    let ping = b"RTPS\x02\x03\x01\x10\0DDSPING".to_vec();
    assert_eq!(pass(&[ping]), [true], "a ping is no packet of RTPS");
}

#[test]
fn a_long_packet_is_truncated_between_two_submessages() {
    let many = packet(FRIEND, &[data().repeat(1000)]);
    let evil = packet(FRIEND, &[data().repeat(1000), fragment(u32::MAX)]);
    let foreign = packet(STRANGER, &[fragment(1000), data().repeat(1000)]);
    let passed = through(IMAGE, Some(&[FRIEND]), &[many, evil, foreign]);
    assert!(passed[0] >= 20 + PLAIN * 28 && (passed[0] - 20).is_multiple_of(28), "{passed:?}");
    assert_eq!(passed[1..], [passed[0], 0]);
    let crowd: Vec<Prefix> = (0..KNOWN as u8).map(|n| [n; 12]).collect();
    let passed = through(IMAGE, Some(&crowd), &[packet(FRIEND, &[data().repeat(1000)])]);
    assert!(passed[0] >= 20 + CROWDED * 28, "{passed:?}");
    let fragments = packet(FRIEND, &[fragment(1000).repeat(200)]);
    assert_eq!(through(IMAGE, None, &[fragments]), [20 + FRAGMENTS * 44]);
}

#[test]
fn random_bytes_are_harmless() {
    let mut state = 1_u64;
    let mut random = move || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    let packets: Vec<Vec<u8>> =
        (0..500).map(|_| (0..2 + random() % 200).map(|_| random() as u8).collect()).collect();
    drop(through(IMAGE, Some(&[FRIEND]), &packets));
}

#[test]
fn no_program_is_longer_than_the_kernel_takes() {
    for known in 0..=KNOWN + 1 {
        let length = assemble(IMAGE, Some(&vec![FRIEND; known])).len();
        assert!(
            length <= MOST && length + 200 > MOST,
            "{known} participants: {length} instructions"
        );
    }
}
