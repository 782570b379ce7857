//! The classic BPF program with which the kernel drops hostile packets before RustDDS reads them.
//!
//! RustDDS allocates and fills the size that the first fragment of a sample claims, up to 4 GiB,
//! for any sender. It also records each sequence number that a HEARTBEAT claims to exist, or a GAP
//! to be missing. The program walks the submessages of a packet and drops it if a fragment claims
//! more than the largest subscription, if it has fragments of an unknown participant, or if it
//! covers too many sequence numbers. Everything else passes. Classic BPF has no loops, so the walk
//! is bounded: at its end the packet is truncated between two submessages, and reliable data is
//! sent again.
//!
//! Sources: DDSI-RTPS 2.3, sections 8.3 and 9.4; the kernel's
//! `Documentation/networking/filter.rst`; RustDDS 0.15.1, `src/rtps`:
//! `fragment_assembler.rs` (`AssemblyBuffer::new`, 128 `MAX_ASSEMBLY_BUFFERS` for each pair of
//! reader and writer, freed by `garbage_collect_before` after 10 s, when a fragment arrives),
//! `reader.rs` (`handle_datafrag_msg`: any writer's name makes a pair), `rtps_writer_proxy.rs`
//! (`missing_seqnums`, `irrelevant_changes_range`: 8 to 30 bytes for each number).

use socket2::SockFilter;

use super::bpf::*;

/// The twelve bytes that the GUIDs of all endpoints of a participant have in common.
pub(super) type Prefix = [u8; 12];

/// Most participants that are listed in the program. In larger domains fragments of any participant
/// pass.
pub(super) const KNOWN: usize = 64;
/// Submessages that may be fragments. Cyclone DDS sends at most 47 in a packet, unless it is
/// configured to send smaller ones.
const FRAGMENTS: usize = 56;
/// Submessages of a big-endian sender. Those are few, and so are their packets.
const BIG_ENDIAN: usize = 16;
/// For the filter, a packet begins with its UDP header.
const UDP: u32 = 8;
const PREFIX: u32 = UDP + 8;
const FIRST: u32 = UDP + 20;

const ACKNACK: u32 = 0x06;
/// Between `ACKNACK` and this one is HEARTBEAT, with two numbers at the same offsets.
const GAP: u32 = 0x08;
const INFO_SRC: u32 = 0x0c;
const DATA_FRAG: u32 = 0x16;

/// Most numbers that a HEARTBEAT or a GAP may span, in units of 65536: only the bytes above the
/// lowest two are compared.
const SPAN: u32 = 16;

/// Memory cell, besides [`PASS`]: 1 if there was a fragment.
const FRAGMENT: u32 = 0;
/// Memory cells while two numbers are compared: the offset of the walk, and the first number.
const WALK: u32 = 2;
const NUMBER: u32 = 3;
const ALL: u32 = u32::MAX;

#[derive(Copy, Clone, PartialEq, Eq)]
enum ByteOrder {
    Low,
    High,
}

/// Builds a program that drops fragments of samples of more than `largest` bytes and, if `known` is
/// given, fragments of other participants.
///
/// There is a tolerance of at least 64 KiB for what encloses a sample: only the two high bytes are
/// compared.
pub(super) fn program(largest: usize, known: Option<&[Prefix]>) -> Vec<SockFilter> {
    assemble(largest, known)
        .into_iter()
        .map(|(code, yes, no, k)| SockFilter::new(code, yes, no, k))
        .collect()
}

fn assemble(largest: usize, known: Option<&[Prefix]>) -> Vec<Instruction> {
    let limit =
        u32::try_from((largest >> 16).saturating_add(1)).map_or(0xffff, |high| high.min(0xffff));
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
    // The first submessage has the byte order of the packet.
    program.put(LD_BYTE_AT, FIRST + 1);
    program.jump(JSET, 1, To::Over(1), NEXT);
    let big_endian = program.put(JA, 0);

    for _ in 0..FRAGMENTS {
        program.step(ByteOrder::Low, Some(limit));
    }
    let rest = TAIL + known.map_or(0, <[Prefix]>::len) * TAIL_OF_ONE + BIG_ENDIAN * STEP + ISLANDS;
    while program.len() + rest < MOST {
        program.step(ByteOrder::Low, None);
    }
    program.cut();
    program.land(big_endian);
    for _ in 0..BIG_ENDIAN {
        program.step(ByteOrder::High, Some(limit));
    }
    program.cut();
    program.tail(known);
    program.code()
}

/// Upper bounds, in instructions. A step after an island has [`RANGE`] more.
const STEP: usize = 29;
const RANGE: usize = 29;
const ISLANDS: usize = BIG_ENDIAN / 5 * (ISLAND + RANGE);
const TAIL: usize = 5;
const TAIL_OF_ONE: usize = 8;

/// Swaps the two bytes of a number.
const SWAP: [(u16, u32); 3] = [(MUL, 0x1_0001), (RSH, 8), (AND, 0xffff)];

impl Program {
    /// Goes from one submessage, at which X points, to the next; also over a time stamp before the
    /// first of them.
    ///
    /// A load beyond the packet's end drops the packet: RustDDS would not accept an incomplete one,
    /// either. Only steps after an island have room to check a HEARTBEAT or a GAP: other steps
    /// leave it to the next one that has.
    fn step(&mut self, order: ByteOrder, limit: Option<u32>) {
        let has_room = self.reach(STEP);
        // Kind, flags and length.
        self.put(LD_WORD, 0);
        self.jump(
            JEQ,
            if order == ByteOrder::Low { 0x0901_0800 } else { 0x0900_0008 },
            NEXT,
            To::Over(4),
        );
        self.put(TXA, 0);
        self.put(ADD, 12);
        self.put(TAX, 0);
        self.put(LD_WORD, 0);
        // A byte order that differs from the first one: no implementation sends it, and a length
        // would be misread.
        let (yes, no) = if order == ByteOrder::Low { (NEXT, To::Drop) } else { (To::Drop, NEXT) };
        self.jump(JSET, 0x0001_0000, yes, no);
        self.put(RSH, 24);
        // It speaks for a participant other than the packet's sender.
        self.jump(JEQ, INFO_SRC, To::Drop, NEXT);
        if has_room {
            self.range(order);
        } else {
            self.jump(JGT, GAP, To::Over(1), NEXT);
            self.jump(JGT, ACKNACK, To::Behind, NEXT);
        }
        match limit {
            Some(limit) => self.fragment(order, limit),
            None => self.jump(JEQ, DATA_FRAG, To::Cut, NEXT),
        }
        self.put(LD_HALF, 2);
        self.jump(JEQ, 0, To::Endless, NEXT);
        if order == ByteOrder::Low {
            // Swaps the bytes: 256 h + l times 256 is h + 256 l modulo 65535. No packet has a
            // length of 65535.
            self.put(LSH, 8);
            self.put(MOD, 0xffff);
        }
        self.put(ADD_X, 0);
        self.put(ADD, 4);
        self.put(TAX, 0);
        self.put(LD_LEN, 0);
        self.jump(JEQ_X, 0, To::End, NEXT);
    }

    /// Drops a HEARTBEAT or a GAP of too many numbers. The value that it leaves in A matches no
    /// kind of submessage that is checked.
    fn range(&mut self, order: ByteOrder) {
        let (swap, one, [top, first, last]): (&[_], _, _) = match order {
            ByteOrder::Low => (&SWAP, 0x0100_0000, [23, 18, 26]),
            ByteOrder::High => (&[], 1, [20, 16, 24]),
        };
        let compare = 15 + 2 * swap.len() as u8;
        self.jump(JGT, GAP, To::Over(compare + 9), NEXT);
        self.jump(JGT, ACKNACK, NEXT, To::Over(compare + 8));
        // After the highest number, RustDDS continues with the lowest, and would never end.
        self.put(LD_BYTE, top);
        self.jump(JEQ, 0, NEXT, To::Drop);
        // A GAP from 1 on moves a mark, at any length: a writer sends it to exclude all earlier
        // samples for a late reader.
        self.put(LD_BYTE, 0);
        self.jump(JEQ, GAP, NEXT, To::Over(4));
        self.put(LD_WORD, 12);
        self.jump(JEQ, 0, NEXT, To::Over(2));
        self.put(LD_WORD, 16);
        self.jump(JEQ, one, To::Over(compare), NEXT);
        self.put(STX, WALK);
        self.put(LD_WORD, 12);
        self.put(ST, NUMBER);
        self.put(LD_WORD, 20);
        self.put(LDX_MEM, NUMBER);
        self.jump(JEQ_X, 0, NEXT, To::Drop);
        self.put(LDX_MEM, WALK);
        for (at, then) in [(first, (ST, NUMBER)), (last, (LDX_MEM, NUMBER))] {
            self.put(LD_HALF, at);
            for (code, k) in swap {
                self.put(*code, *k);
            }
            self.put(then.0, then.1);
        }
        self.put(SUB_X, 0);
        // The first number of an empty range is one more than the last.
        self.put(ADD, 1);
        self.put(LDX_MEM, WALK);
        self.jump(JGT, SPAN + 1, To::Drop, NEXT);
    }

    fn fragment(&mut self, order: ByteOrder, limit: u32) {
        let swap: &[(u16, u32)] = match order {
            // Unlike above, all 16 bits matter: a claim of 4 GiB begins with 65535.
            ByteOrder::Low => &SWAP,
            ByteOrder::High => &[],
        };
        let over = 5 + swap.len();
        self.jump(JEQ, DATA_FRAG, NEXT, To::Over(u8::try_from(over).unwrap_or(0)));
        // The fragment size, which RustDDS keeps for all later samples of the writer.
        self.put(LD_HALF, 30);
        self.jump(JEQ, 0, To::Drop, NEXT);
        self.put(ST, FRAGMENT);
        // The two high bytes of the sample's size.
        self.put(LD_HALF, if order == ByteOrder::Low { 34 } else { 32 });
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
mod tests;
