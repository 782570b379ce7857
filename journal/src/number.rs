//! Variable-length encoding of whole numbers (LEB128): seven bits in each byte, the lowest first;
//! the eighth bit means that more follow.

/// Maximum length of a number, in bytes.
pub(crate) const NUMBER_MAX: usize = 10;

pub(crate) fn put(mut number: u64, out: &mut Vec<u8>) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}

/// Removes and returns the number at the start of `bytes`; `None` if it has no end or more than 64
/// bits.
pub(crate) fn take(bytes: &mut &[u8]) -> Option<u64> {
    let mut number = 0;
    for (index, byte) in bytes.iter().take(NUMBER_MAX).enumerate() {
        let bits = u64::from(byte & 0x7f);
        let shift = 7 * index as u32;
        if bits.leading_zeros() < shift {
            return None;
        }
        number |= bits << shift;
        if byte & 0x80 == 0 {
            *bytes = &bytes[index + 1..];
            return Some(number);
        }
    }
    None
}

/// Maps a signed difference to an unsigned number that is small for close numbers (zigzag): 0, -1,
/// 1, -2 become 0, 1, 2, 3.
pub(crate) fn fold(difference: u64) -> u64 {
    (difference << 1) ^ (((difference as i64) >> 63) as u64)
}

pub(crate) fn unfold(folded: u64) -> u64 {
    (folded >> 1) ^ (folded & 1).wrapping_neg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_is_decoded_as_encoded() {
        let powers = (0..64).flat_map(|bit| [(1 << bit) - 1, 1 << bit, (1 << bit) + 1]);
        for number in powers.chain([u64::MAX - 1, u64::MAX]) {
            let mut bytes = Vec::new();
            put(number, &mut bytes);
            assert_eq!(bytes.len(), ((64 - number.leading_zeros()).div_ceil(7) as usize).max(1));
            bytes.push(9);
            let mut rest = bytes.as_slice();
            assert_eq!(take(&mut rest), Some(number));
            assert_eq!(rest, [9]);
            assert_eq!(unfold(fold(number)), number);
        }
    }

    #[test]
    fn numbers_that_are_close_fold_to_small_ones() {
        let folded =
            [0_i64, -1, 1, -2, 2, i64::MAX, i64::MIN].map(|difference| fold(difference as u64));
        assert_eq!(folded, [0, 1, 2, 3, 4, u64::MAX - 1, u64::MAX]);
    }

    #[test]
    fn a_number_without_an_end_or_beyond_64_bits_is_none() {
        for bytes in [&[][..], &[0x80], &[0xff; 9], &[0xff; 10], &[0x80; 20]] {
            assert_eq!(take(&mut &*bytes), None, "{bytes:?}");
        }
        let mut largest = vec![0xff; 9];
        largest.push(1);
        assert_eq!(take(&mut largest.as_slice()), Some(u64::MAX));
        largest[9] = 2;
        assert_eq!(take(&mut largest.as_slice()), None);
    }
}
