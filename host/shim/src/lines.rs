//! Bytes of a pipe as lines of bounded length.

use gleaner_lambda::PAGE_BYTES;

/// Bytes that are read at once.
pub(crate) const PIECE: usize = 64 << 10;
/// Bytes that a line counts for, at least: parsing one costs time, however short it is.
const LINE_COST: usize = 256;

/// Bytes as they come, as lines of bounded length.
#[derive(Default)]
pub(crate) struct Lines {
    line: Vec<u8>,
    /// The line is too long, and is skipped up to its end.
    is_skipped: bool,
}

impl Lines {
    /// Gives `each` line that is whole with these bytes, and `None` once for one that is too long.
    /// Returns the cost of the bytes.
    pub(crate) fn add(&mut self, bytes: &[u8], mut each: impl FnMut(Option<&[u8]>)) -> usize {
        let mut cost = 0;
        for part in bytes.split_inclusive(|byte| *byte == b'\n') {
            cost += part.len().max(LINE_COST);
            if !self.is_skipped && self.line.len() + part.len() > PAGE_BYTES {
                self.is_skipped = true;
                self.line = Vec::new();
                each(None);
            }
            if !self.is_skipped {
                self.line.extend_from_slice(part);
            }
            if part.ends_with(b"\n") {
                if !std::mem::take(&mut self.is_skipped) {
                    each(Some(&self.line));
                }
                self.line.clear();
                // A long line is rare.
                self.line.shrink_to(PIECE);
            }
        }
        cost
    }

    /// Returns whether an unfinished line is held.
    pub(crate) fn is_within(&self) -> bool {
        !self.line.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lines of `text`, which comes in pieces of `size` bytes; one that is too long has the
    /// length 0.
    fn lengths(text: &[u8], size: usize) -> Vec<usize> {
        let mut lines = Lines::default();
        let mut lengths = Vec::new();
        for piece in text.chunks(size) {
            lines.add(piece, |line| lengths.push(line.map_or(0, <[u8]>::len)));
        }
        lengths
    }

    #[test]
    fn lines_are_the_same_in_whatever_pieces_they_come() {
        let fits = [vec![b'x'; PAGE_BYTES - 1], b"\n".to_vec()].concat();
        let long = [vec![b'x'; PAGE_BYTES], b"\n".to_vec()].concat();
        let longer = [vec![b'x'; 3 * PAGE_BYTES], b"\n".to_vec()].concat();
        let text = [
            b"ab\n\n".to_vec(),
            fits,
            b"c\n".to_vec(),
            long,
            b"cd\n".to_vec(),
            longer,
            b"e\nrest".to_vec(),
        ]
        .concat();
        for size in [7, PIECE - 1, PIECE, PAGE_BYTES, text.len()] {
            assert_eq!(
                lengths(&text, size),
                [3, 1, PAGE_BYTES, 2, 0, 3, 0, 2],
                "in pieces of {size}"
            );
        }
    }

    #[test]
    fn short_lines_cost_what_parsing_them_does() {
        let mut lines = Lines::default();
        assert_eq!(lines.add(&[b'\n'; 100], |_| {}), 100 * LINE_COST);
        assert_eq!(lines.add(&[b'x'; 1000], |_| {}), 1000);
        assert!(lines.is_within());
    }
}
