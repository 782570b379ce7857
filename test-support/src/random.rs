//! Random numbers that can be repeated.

/// The generator xorshift64: the same numbers for the same start, which is not 0.
pub struct XorShift64(pub u64);

impl XorShift64 {
    pub fn number(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// A number below `n`, which is not 0.
    pub fn below(&mut self, n: usize) -> usize {
        (self.number() % n as u64) as usize
    }
}
