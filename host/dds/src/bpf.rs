//! Assembles programs of classic BPF: instructions, and jumps between them.
//!
//! A conditional jump skips at most 255 instructions, and none goes back. So the exits that many
//! jumps share are repeated, as islands between the instructions.
//!
//! Source: the kernel's `Documentation/networking/filter.rst` and
//! `include/uapi/linux/bpf_common.h`.

/// The most instructions that the kernel accepts.
pub(super) const MOST: usize = 4096;
/// The most instructions that a conditional jump can skip.
pub(super) const FAR: usize = 255;

pub(super) const LD_IMM: u16 = 0x00;
pub(super) const LDX_IMM: u16 = 0x01;
pub(super) const ST: u16 = 0x02;
pub(super) const STX: u16 = 0x03;
pub(super) const ADD: u16 = 0x04;
pub(super) const JA: u16 = 0x05;
pub(super) const RET: u16 = 0x06;
pub(super) const TAX: u16 = 0x07;
pub(super) const ADD_X: u16 = 0x0c;
pub(super) const JEQ: u16 = 0x15;
pub(super) const RET_A: u16 = 0x16;
pub(super) const SUB_X: u16 = 0x1c;
pub(super) const JEQ_X: u16 = 0x1d;
pub(super) const LD_WORD_AT: u16 = 0x20;
pub(super) const MUL: u16 = 0x24;
pub(super) const JGT: u16 = 0x25;
pub(super) const LD_BYTE_AT: u16 = 0x30;
pub(super) const LD_WORD: u16 = 0x40;
pub(super) const JSET: u16 = 0x45;
pub(super) const LD_HALF: u16 = 0x48;
pub(super) const LD_BYTE: u16 = 0x50;
pub(super) const AND: u16 = 0x54;
pub(super) const LD_MEM: u16 = 0x60;
pub(super) const LDX_MEM: u16 = 0x61;
pub(super) const LSH: u16 = 0x64;
pub(super) const RSH: u16 = 0x74;
pub(super) const LD_LEN: u16 = 0x80;
pub(super) const TXA: u16 = 0x87;
pub(super) const MOD: u16 = 0x94;

/// Memory cell: the number of bytes of the packet that pass.
pub(super) const PASS: u32 = 1;

/// Kinds of submessages that may be empty.
const PAD: u32 = 0x01;
const INFO_TS: u32 = 0x09;

/// Instructions of an island, at most.
pub(super) const ISLAND: usize = 17;

/// Operation, instructions to skip if its condition holds and if not, and its operand.
pub(super) type Instruction = (u16, u8, u8, u32);

/// The target of a conditional jump.
#[derive(Copy, Clone, PartialEq, Eq)]
pub(super) enum To {
    /// Skips this many instructions.
    Over(u8),
    Drop,
    /// The submessage has no length.
    Endless,
    /// The packet is truncated here.
    Cut,
    End,
    /// The code after the next island checks the same submessage.
    Behind,
}

pub(super) const NEXT: To = To::Over(0);

/// A program under construction. X is the offset of the walk through a packet.
#[derive(Default)]
pub(super) struct Program {
    code: Vec<Instruction>,
    /// Jumps to an exit of the next island: instruction, and true if it jumps when the condition
    /// holds.
    exits: Vec<(usize, bool, To)>,
    /// Jumps to the end of the program.
    ends: Vec<usize>,
}

impl Program {
    pub(super) fn len(&self) -> usize {
        self.code.len()
    }

    pub(super) fn code(self) -> Vec<Instruction> {
        self.code
    }

    /// Appends an instruction and returns its index.
    pub(super) fn put(&mut self, code: u16, k: u32) -> usize {
        self.code.push((code, 0, 0, k));
        self.code.len() - 1
    }

    pub(super) fn jump(&mut self, code: u16, k: u32, yes: To, no: To) {
        let at = self.put(code, k);
        for (holds, to) in [(true, yes), (false, no)] {
            match to {
                To::Over(over) if holds => self.code[at].1 = over,
                To::Over(over) => self.code[at].2 = over,
                exit => self.exits.push((at, holds, exit)),
            }
        }
    }

    /// Makes the unconditional jump `from` go to the next instruction.
    pub(super) fn land(&mut self, from: usize) {
        self.code[from].3 =
            u32::try_from(self.code.len() - from - 1).expect("a program has 4096 instructions");
    }

    /// Makes sure that all exits reach an island after `instructions` more. Returns true if an
    /// island is appended now.
    pub(super) fn reach(&mut self, instructions: usize) -> bool {
        let far = self
            .exits
            .first()
            .is_some_and(|(at, ..)| self.code.len() + instructions + ISLAND - at > FAR);
        if far {
            self.island();
        }
        far
    }

    pub(super) fn cut(&mut self) {
        self.island();
        self.put(TXA, 0);
        self.put(ST, PASS);
        let end = self.put(JA, 0);
        self.ends.push(end);
    }

    /// Makes all jumps to the end go to the next instruction.
    pub(super) fn end(&mut self) {
        for end in std::mem::take(&mut self.ends) {
            self.land(end);
        }
    }

    /// Appends the targets of the exits before it. The normal flow jumps over them.
    fn island(&mut self) {
        let over = self.put(JA, 0);
        let drop = self.put(RET, 0);
        // Without a length, paddings and time stamps are empty, and any other submessage is the
        // packet's last.
        let endless = self.put(LD_BYTE, 0);
        self.jump(JEQ, PAD, To::Over(4), NEXT);
        self.jump(JEQ, INFO_TS, To::Over(3), To::Over(2));
        let cut = self.put(TXA, 0);
        self.put(ST, PASS);
        let end = self.put(JA, 0);
        // The walk continues after the island from any step: steps are alike.
        self.put(TXA, 0);
        self.put(ADD, 4);
        self.put(TAX, 0);
        self.put(LD_LEN, 0);
        self.jump(JEQ_X, 0, NEXT, To::Over(1));
        let empty = self.put(JA, 0);
        self.ends.extend([end, empty]);
        self.land(over);
        let behind = self.code.len();
        for (at, holds, exit) in std::mem::take(&mut self.exits) {
            let place = match exit {
                To::Drop => drop,
                To::Endless => endless,
                To::Cut => cut,
                To::End => end,
                To::Behind => behind,
                To::Over(_) => continue,
            };
            let far =
                u8::try_from(place - at - 1).expect("there is an island before it is too far");
            if holds { self.code[at].1 = far } else { self.code[at].2 = far }
        }
    }
}
