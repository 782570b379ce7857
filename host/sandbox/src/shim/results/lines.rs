//! Splits the bytes of a pipe into lines of bounded length.

use gleaner_lambda::RESULT_ITEM_MAX;

/// Size of a read, in bytes.
pub(crate) const PIECE: usize = 64 << 10;
/// Minimum cost of a line, in bytes: parsing a line takes time, however short it is.
const LINE_COST: usize = 256;

/// Splits a stream of bytes into lines of bounded length.
#[derive(Default)]
pub(crate) struct LineSplitter {
    line: Vec<u8>,
    /// Set while the line is too long, and skipped to its end.
    is_skipped: bool,
}

impl LineSplitter {
    /// Adds `bytes`. Calls `each` with every line that they complete, and once with `None` for a
    /// line that is too long. Returns the cost of the bytes.
    pub(crate) fn add(&mut self, bytes: &[u8], mut each: impl FnMut(Option<&[u8]>)) -> usize {
        let mut cost = 0;
        for part in bytes.split_inclusive(|byte| *byte == b'\n') {
            cost += part.len().max(LINE_COST);
            if !self.is_skipped && self.line.len() + part.len() > RESULT_ITEM_MAX {
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
                // Long lines are rare.
                self.line.shrink_to(PIECE);
            }
        }
        cost
    }

    pub(crate) fn is_within(&self) -> bool {
        !self.line.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the lengths of the lines of `text`, added in pieces of `size` bytes; 0 for a line
    /// that is too long.
    fn lengths(text: &[u8], size: usize) -> Vec<usize> {
        let mut lines = LineSplitter::default();
        let mut lengths = Vec::new();
        for piece in text.chunks(size) {
            lines.add(piece, |line| lengths.push(line.map_or(0, <[u8]>::len)));
        }
        lengths
    }

    #[test]
    fn the_lines_do_not_depend_on_the_sizes_of_the_pieces() {
        let fits = [vec![b'x'; RESULT_ITEM_MAX - 1], b"\n".to_vec()].concat();
        let long = [vec![b'x'; RESULT_ITEM_MAX], b"\n".to_vec()].concat();
        let longer = [vec![b'x'; 3 * RESULT_ITEM_MAX], b"\n".to_vec()].concat();
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
        for size in [7, PIECE - 1, PIECE, RESULT_ITEM_MAX, text.len()] {
            assert_eq!(
                lengths(&text, size),
                [3, 1, RESULT_ITEM_MAX, 2, 0, 3, 0, 2],
                "in pieces of {size}"
            );
        }
    }

    #[test]
    fn a_short_line_costs_at_least_as_much_as_its_parsing() {
        let mut lines = LineSplitter::default();
        assert_eq!(lines.add(&[b'\n'; 100], |_| {}), 100 * LINE_COST);
        assert_eq!(lines.add(&[b'x'; 1000], |_| {}), 1000);
        assert!(lines.is_within());
    }
}
