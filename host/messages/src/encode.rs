//! Writes CDR for Gleaner's own messages: their fields are known, so this is little more than
//! alignment.

/// A message as little-endian CDR, without the four bytes of encapsulation.
#[derive(Debug, Default)]
pub struct CdrWriter(Vec<u8>);

impl CdrWriter {
    pub fn new() -> Self {
        Self::default()
    }

    pub fn u8(&mut self, value: u8) -> &mut Self {
        self.aligned(&[value])
    }

    pub fn i32(&mut self, value: i32) -> &mut Self {
        self.aligned(&value.to_le_bytes())
    }

    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.aligned(&value.to_le_bytes())
    }

    pub fn u64(&mut self, value: u64) -> &mut Self {
        self.aligned(&value.to_le_bytes())
    }

    /// Adds `float64`s, as of an array of fixed length.
    pub fn f64s(&mut self, values: &[f64]) -> &mut Self {
        values.iter().fold(self, |cdr, value| cdr.aligned(&value.to_le_bytes()))
    }

    /// Adds a `string`, truncated to 4 GiB.
    pub fn string(&mut self, text: &str) -> &mut Self {
        let len = text.len().min(u32::MAX as usize - 1);
        self.u32(len as u32 + 1);
        self.0.extend_from_slice(&text.as_bytes()[..len]);
        self.0.push(0);
        self
    }

    /// Adds a `builtin_interfaces/Time` of nanoseconds, clamped to its range.
    pub fn time(&mut self, ns: i64) -> &mut Self {
        let seconds = ns.div_euclid(1_000_000_000).clamp(i32::MIN.into(), i32::MAX.into());
        self.i32(seconds as i32).u32(ns.rem_euclid(1_000_000_000) as u32)
    }

    pub fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// Clears the message, and keeps its memory.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    fn aligned(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.resize(self.0.len().next_multiple_of(bytes.len()), 0);
        self.0.extend_from_slice(bytes);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_aligned_and_strings_end_in_zero() {
        let mut cdr = CdrWriter::new();
        cdr.string("ab").u32(7).time(-1);
        assert_eq!(
            cdr.bytes(),
            [3, 0, 0, 0, b'a', b'b', 0, 0, 7, 0, 0, 0, 255, 255, 255, 255, 255, 201, 154, 59]
        );
    }
}
