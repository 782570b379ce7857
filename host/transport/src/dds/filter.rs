//! The program by which the kernel drops hostile fragments before RustDDS sees them: classic BPF.
//!
//! RustDDS reserves and fills what the first fragment of a sample claims to be the sample's size, up to 4 GiB, whoever sent
//! it. The program walks the submessages of a packet and drops it if a fragment claims more than anybody subscribed to, or
//! if it has fragments of a participant that nobody knows. All else passes. Classic BPF has no loops, so the walk ends
//! somewhere: there the packet is cut off between two submessages, and what is reliable comes again.
//!
//! Sources: DDSI-RTPS 2.3, sections 8.3 and 9.4; the kernel's `Documentation/networking/filter.rst`.

use socket2::SockFilter;

use super::bpf::*;

/// The twelve bytes that all endpoints of a participant have in common.
pub(super) type Prefix = [u8; 12];

/// Most participants whose fragments are told from a stranger's. In larger domains nobody is a stranger.
pub(super) const KNOWN: usize = 64;
/// Submessages that may be fragments. Cyclone DDS sends at most 47 in a packet, unless it was told to send smaller ones.
const FRAGMENTS: usize = 56;
/// Of a machine whose numbers begin with the high byte. They are few, and their packets as well.
const BIG_ENDIAN: usize = 16;
/// The kernel shows a packet from its UDP header on.
const UDP: u32 = 8;
const PREFIX: u32 = UDP + 8;
const FIRST: u32 = UDP + 20;

const INFO_SRC: u32 = 0x0c;
const DATA_FRAG: u32 = 0x16;

/// In memory, besides [`PASS`]: whether there was a fragment.
const FRAGMENT: u32 = 0;
const ALL: u32 = u32::MAX;

/// How a submessage's numbers begin.
#[derive(Copy, Clone, PartialEq, Eq)]
enum Order {
    Low,
    High,
}

/// A program that drops fragments of samples of more than `largest` bytes and, if `known` is given, fragments of others.
///
/// There is a tolerance of at least 64 KiB for what encloses a sample: only the two high bytes are compared.
pub(super) fn program(largest: usize, known: Option<&[Prefix]>) -> Vec<SockFilter> {
    assemble(largest, known).into_iter().map(|(code, yes, no, k)| SockFilter::new(code, yes, no, k)).collect()
}

fn assemble(largest: usize, known: Option<&[Prefix]>) -> Vec<Instruction> {
    let limit = u32::try_from((largest >> 16).saturating_add(1)).map_or(0xffff, |high| high.min(0xffff));
    let known = known.map(|known| &known[..known.len().min(KNOWN)]);
    let mut program = Program::default();
    for (place, value) in [(FRAGMENT, 0), (PASS, ALL)] {
        program.put(LD_IMM, value);
        program.put(ST, place);
    }
    program.put(LD_LEN, 0);
    program.jump(JGT, FIRST, To::Over(1), NEXT);
    program.put(RET, ALL);
    program.put(LDX_IMM, FIRST);
    // The first submessage tells how the packet's numbers begin.
    program.put(LD_BYTE_AT, FIRST + 1);
    program.jump(JSET, 1, To::Over(1), NEXT);
    let big_endian = program.put(JA, 0);

    for _ in 0..FRAGMENTS {
        program.step(Order::Low, Some(limit));
    }
    let rest = TAIL + known.map_or(0, <[Prefix]>::len) * TAIL_OF_ONE + BIG_ENDIAN * STEP + ISLANDS;
    while program.len() + rest < MOST {
        program.step(Order::Low, None);
    }
    program.cut();
    program.land(big_endian);
    for _ in 0..BIG_ENDIAN {
        program.step(Order::High, Some(limit));
    }
    program.cut();
    program.tail(known);
    program.code()
}

/// At most, in instructions.
const STEP: usize = 27;
const ISLANDS: usize = (BIG_ENDIAN / 8 + 4) * ISLAND;
const TAIL: usize = 5;
const TAIL_OF_ONE: usize = 8;

impl Program {
    /// Goes from one submessage, at which X points, to the next; and over a time stamp before the first of them.
    ///
    /// A load behind the packet's end drops the packet: RustDDS would not take one that is not whole, either.
    fn step(&mut self, order: Order, limit: Option<u32>) {
        self.reach(STEP);
        // Kind, flags and length.
        self.put(LD_WORD, 0);
        self.jump(JEQ, if order == Order::Low { 0x0901_0800 } else { 0x0900_0008 }, NEXT, To::Over(4));
        self.put(TXA, 0);
        self.put(ADD, 12);
        self.put(TAX, 0);
        self.put(LD_WORD, 0);
        // Numbers that begin the other way than the first ones: nobody sends them, and a length would be misread.
        let (yes, no) = if order == Order::Low { (NEXT, To::Drop) } else { (To::Drop, NEXT) };
        self.jump(JSET, 0x0001_0000, yes, no);
        self.put(RSH, 24);
        // It speaks for another participant than the packet's.
        self.jump(JEQ, INFO_SRC, To::Drop, NEXT);
        match limit {
            Some(limit) => self.fragment(order, limit),
            None => self.jump(JEQ, DATA_FRAG, To::Cut, NEXT),
        }
        self.put(LD_HALF, 2);
        self.jump(JEQ, 0, To::Endless, NEXT);
        if order == Order::Low {
            // Swaps the bytes: 256 h + l times 256 is h + 256 l modulo 65535. A length of 65535 no packet has.
            self.put(LSH, 8);
            self.put(MOD, 0xffff);
        }
        self.put(ADD_X, 0);
        self.put(ADD, 4);
        self.put(TAX, 0);
        self.put(LD_LEN, 0);
        self.jump(JEQ_X, 0, To::End, NEXT);
    }

    fn fragment(&mut self, order: Order, limit: u32) {
        let swap: &[(u16, u32)] = match order {
            // Not as above: a claim of 4 GiB begins with 65535.
            Order::Low => &[(MUL, 0x1_0001), (RSH, 8), (AND, 0xffff)],
            Order::High => &[],
        };
        let over = 5 + swap.len();
        self.jump(JEQ, DATA_FRAG, NEXT, To::Over(u8::try_from(over).unwrap_or(0)));
        // The size of fragments, which RustDDS keeps for all that the writer sends later.
        self.put(LD_HALF, 30);
        self.jump(JEQ, 0, To::Drop, NEXT);
        self.put(ST, FRAGMENT);
        // The two high bytes of the sample's size.
        self.put(LD_HALF, if order == Order::Low { 34 } else { 32 });
        for (code, k) in swap {
            self.put(*code, *k);
        }
        self.jump(JGT, limit, To::Drop, NEXT);
    }

    fn tail(&mut self, known: Option<&[Prefix]>) {
        self.end();
        if let Some(known) = known {
            self.put(LD_MEM, FRAGMENT);
            self.jump(JEQ, 0, NEXT, To::Over(2));
            self.put(LD_MEM, PASS);
            self.put(RET_A, 0);
            for prefix in known {
                let (words, _) = prefix.as_chunks::<4>();
                // The last word first: it differs most.
                for (n, word) in words.iter().enumerate().rev() {
                    self.put(LD_WORD_AT, PREFIX + 4 * n as u32);
                    self.jump(JEQ, u32::from_be_bytes(*word), NEXT, To::Over(2 * n as u8 + 2));
                }
                self.put(LD_MEM, PASS);
                self.put(RET_A, 0);
            }
            self.put(RET, 0);
        } else {
            self.put(LD_MEM, PASS);
            self.put(RET_A, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use socket2::SockRef;

    use super::*;

    const FRIEND: Prefix = *b"a friend....";
    const STRANGER: Prefix = *b"a stranger..";
    const IMAGE: usize = 25 << 20;

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

    fn stamp() -> Vec<u8> {
        submessage(true, 0x09, &[7; 8])
    }

    fn data() -> Vec<u8> {
        submessage(true, 0x15, &[0x16; 24])
    }

    /// What of each packet comes through the kernel; 0 bytes if it does not.
    fn through(largest: usize, known: Option<&[Prefix]>, packets: &[Vec<u8>]) -> Vec<usize> {
        let [here, there] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        SockRef::from(&here).attach_filter(&program(largest, known)).unwrap();
        let mut bytes = [0; 65_536];
        let mut passed = |packet: &Vec<u8>| {
            there.send_to(packet, here.local_addr().unwrap()).unwrap();
            // Less than a header passes, and says that nothing came before it.
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
    fn a_fragment_that_claims_more_than_anybody_asked_for_is_dropped_in_either_byte_order() {
        let claims = [1_u32, 0xffff, 0x1_0000, 25 << 20, (25 << 20) + 65_536, (25 << 20) + 131_072, 1 << 30, u32::MAX];
        for little in [true, false] {
            let packets = claims.map(|size| packet(FRIEND, &[fragment_of(little, size, 1000)]));
            assert_eq!(pass(&packets), [true, true, true, true, true, false, false, false], "little: {little}");
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
                let packets: Vec<_> = sizes.iter().map(|n| packet(FRIEND, &[fragment_of(little, *n, 9)])).collect();
                for (size, passed) in sizes.iter().zip(through(largest, None, &packets)) {
                    let (size, largest) = (u64::from(*size), largest as u64);
                    let (must, may) = (size <= largest.saturating_add(65_536), size < largest.saturating_add(131_072));
                    assert!(if passed > 0 { may } else { !must }, "{size} of at most {largest}: {passed}");
                }
            }
        }
    }

    #[test]
    fn fragments_of_strangers_are_dropped_and_everything_else_of_theirs_passes() {
        let claims = [fragment(1000), [stamp(), fragment(1000)].concat(), [data(), fragment(1000)].concat()];
        let packets = claims.map(|claim| packet(STRANGER, &[claim]));
        assert_eq!(pass(&packets), [false; 3]);
        assert_eq!(pass(&[packet(STRANGER, &[stamp(), data()]), packet(STRANGER, &[])]), [true; 2]);
        assert!(through(IMAGE, None, &packets).iter().all(|passed| *passed > 0), "where nobody is a stranger");
        assert_eq!(through(IMAGE, Some(&[]), &[packet(FRIEND, &[fragment(1000)])]), [0]);
    }

    #[test]
    fn each_of_as_many_participants_as_can_be_known_is_known() {
        let known: Vec<Prefix> = (0..KNOWN as u8).map(|n| [n; 12]).collect();
        let packets: Vec<_> = known.iter().map(|prefix| packet(*prefix, &[fragment(1000)])).collect();
        assert!(through(IMAGE, Some(&known), &packets).iter().all(|passed| *passed > 0));
        let like_one = packet([&[5; 11][..], &[6]].concat().try_into().unwrap(), &[fragment(1000)]);
        assert_eq!(through(IMAGE, Some(&known), &[like_one]), [0]);
    }

    #[test]
    fn a_claim_is_found_wherever_it_hides() {
        let evil = fragment(u32::MAX);
        let pad = submessage(true, 1, &[]);
        let empty_stamp = vec![0x09, 3, 0, 0];
        let fronts = [vec![], stamp(), data(), pad, empty_stamp, fragment(1000), [stamp(), stamp(), data()].concat()];
        for front in fronts {
            for repeat in [1, 3, 9, 30] {
                let hidden = packet(FRIEND, &[front.repeat(repeat), evil.clone()]);
                let passed = through(IMAGE, None, std::slice::from_ref(&hidden))[0];
                assert!(passed <= hidden.len() - evil.len(), "{repeat} of {front:?}");
            }
        }
        let mut endless = evil.clone();
        endless[2..4].fill(0);
        let in_big_endian = [submessage(true, 1, &[]), fragment_of(false, u32::MAX, 1000)].concat();
        let another = [submessage(true, 0x0c, &[0; 20]), fragment(1000)].concat();
        assert_eq!(pass(&[endless, in_big_endian, another].map(|evil| packet(FRIEND, &[evil]))), [false; 3]);
    }

    #[test]
    fn ordinary_packets_pass_whole() {
        let mut last = data();
        last[2..4].fill(0);
        let dense: Vec<_> = (0..47).flat_map(|_| [stamp(), fragment(6 << 20)]).chain([data()]).collect();
        let pairs = [stamp(), data()].concat().repeat(140);
        let big_endian: Vec<_> = (0..15).map(|_| fragment_of(false, 6 << 20, 1000)).collect();
        let empty_stamps = [vec![9, 3, 0, 0], data()].concat().repeat(5);
        let contents = [dense, vec![pairs], big_endian, vec![empty_stamps], vec![last], vec![]];
        assert_eq!(pass(&contents.map(|content| packet(FRIEND, &content))), [true; 6]);
        assert_eq!(pass(&[b"RTPS\x02\x03\x01\x10\0DDSPING".to_vec()]), [true], "a ping is no packet of RTPS");
    }

    #[test]
    fn what_nobody_walks_to_the_end_is_cut_between_two_submessages() {
        let many = packet(FRIEND, &[data().repeat(1000)]);
        let evil = packet(FRIEND, &[data().repeat(1000), fragment(u32::MAX)]);
        let foreign = packet(STRANGER, &[fragment(1000), data().repeat(1000)]);
        let passed = through(IMAGE, Some(&[FRIEND]), &[many, evil, foreign]);
        assert!(passed[0] >= 20 + 140 * 28 && (passed[0] - 20).is_multiple_of(28), "{passed:?}");
        assert_eq!(passed[1..], [passed[0], 0]);
        let crowd: Vec<Prefix> = (0..KNOWN as u8).map(|n| [n; 12]).collect();
        let passed = through(IMAGE, Some(&crowd), &[packet(FRIEND, &[data().repeat(1000)])]);
        assert!(passed[0] >= 20 + 120 * 28, "{passed:?}");
        let fragments = packet(FRIEND, &[fragment(1000).repeat(200)]);
        assert_eq!(through(IMAGE, None, &[fragments]), [20 + FRAGMENTS * 44]);
    }

    #[test]
    fn bytes_that_mean_nothing_harm_nothing() {
        let mut state = 1_u64;
        let mut random = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
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
            assert!(length <= MOST && length + 200 > MOST, "{known} participants: {length} instructions");
        }
    }
}
