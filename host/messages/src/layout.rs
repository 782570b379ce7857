//! Computes the size of values of fixed size, padding included.
//!
//! Padding depends on the start of the value, but only modulo 8, the largest alignment. So eight
//! numbers suffice: any run of fixed-size fields, however long, is skipped by one table look-up and
//! one addition, even after a string of unknown length.

use super::parse::Primitive;

/// Bytes from a start position `p` to the end of the value, indexed by `p % 8`.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct SkipTable([u32; 8]);

impl SkipTable {
    pub(super) const EMPTY: Self = Self([0; 8]);

    pub(super) fn primitive(primitive: Primitive) -> Self {
        let size = primitive.size();
        let mut steps = [0; 8];
        for (start, step) in steps.iter_mut().enumerate() {
            // At most 7 bytes of padding and 8 of value.
            *step = (start.next_multiple_of(size) - start + size) as u32;
        }
        Self(steps)
    }

    /// Returns the table of `self` followed by `next`; `None` if that takes 4 GiB or more.
    pub(super) fn then(&self, next: &Self) -> Option<Self> {
        let mut steps = [0; 8];
        for (start, step) in steps.iter_mut().enumerate() {
            let first = self.0[start];
            *step = first.checked_add(next.0[(start + first as usize) % 8])?;
        }
        Some(Self(steps))
    }

    /// Returns the table of `self` repeated `n` times; `None` if that takes 4 GiB or more.
    pub(super) fn times(&self, n: usize) -> Option<Self> {
        // Binary powers: `then` is associative, so 28 doublings cover the longest array.
        let (mut result, mut power, mut left) = (Self::EMPTY, *self, n);
        while left > 0 {
            if left % 2 == 1 {
                result = result.then(&power)?;
            }
            left /= 2;
            if left > 0 {
                power = power.then(&power)?;
            }
        }
        Some(result)
    }

    /// Returns the end of a value that starts at `pos`.
    #[inline]
    pub(super) fn after(&self, pos: usize) -> usize {
        pos.saturating_add(self.0[pos % 8] as usize)
    }

    /// Returns the end of `n` values in a row, in a bounded number of steps.
    pub(super) fn after_times(&self, mut pos: usize, n: usize) -> usize {
        // There are eight residues, so the ninth element at the latest starts like an earlier one,
        // and from there on the steps repeat.
        let mut seen = [None; 8];
        let mut done = 0;
        while done < n {
            if let Some((before, at)) = seen[pos % 8].replace((done, pos)) {
                let (period, stride) = (done - before, pos - at);
                let cycles = (n - done) / period;
                pos = pos.saturating_add(cycles.saturating_mul(stride));
                done += cycles * period;
                // Less than a period is left: no more search for cycles.
                for _ in done..n {
                    pos = self.after(pos);
                }
                return pos;
            }
            pos = self.after(pos);
            done += 1;
        }
        pos
    }
}

/// The size of a value, as far as its type determines it.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Layout {
    /// The same size in every message.
    Fixed(SkipTable),
    /// Contains a string or a sequence.
    Variable,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walked(table: &SkipTable, start: usize, n: usize) -> usize {
        (0..n).fold(start, |pos, _| table.after(pos))
    }

    #[test]
    fn a_run_counts_its_padding() {
        let byte_then_double = SkipTable::primitive(Primitive::U8)
            .then(&SkipTable::primitive(Primitive::F64))
            .unwrap();
        assert_eq!(byte_then_double.after(0), 16);
        assert_eq!(byte_then_double.after(7), 16);
        assert_eq!(byte_then_double.after(8), 24);
    }

    #[test]
    fn repeating_equals_walking_from_every_start() {
        let odd = SkipTable::primitive(Primitive::U32)
            .then(&SkipTable::primitive(Primitive::U8))
            .and_then(|table| table.then(&SkipTable::primitive(Primitive::U16)))
            .unwrap();
        let wide = SkipTable::primitive(Primitive::F64)
            .then(&SkipTable::primitive(Primitive::U8))
            .unwrap();
        for table in [odd, wide] {
            for start in 0..16 {
                for n in [0, 1, 2, 3, 7, 8, 9, 10, 63, 64, 1000] {
                    let expected = walked(&table, start, n);
                    assert_eq!(table.after_times(start, n), expected);
                    assert_eq!(table.times(n).unwrap().after(start), expected);
                }
            }
        }
    }

    #[test]
    fn absurd_sizes_are_refused_instead_of_wrapping() {
        let double = SkipTable::primitive(Primitive::F64);
        let giant = double.times(1 << 28).unwrap();
        assert_eq!(giant.after(0), 1 << 31);
        assert_eq!(giant.times(2), None);
        assert_eq!(double.times(usize::MAX), None);
        assert_eq!(double.after_times(0, usize::MAX), usize::MAX);
    }
}
