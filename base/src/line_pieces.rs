//! Splits the standard error of a child into lines of bounded length, to be forwarded.

use std::io::{BufRead, BufReader, Read};

/// Most bytes of a piece.
const PIECE_MAX: u64 = 8192;

/// A line, or a part of a line longer than 8 KiB.
#[derive(Debug)]
pub struct LinePiece<'a> {
    /// Its bytes, including the line break, if any.
    pub bytes: &'a [u8],
    /// True if it is the first piece of its line.
    pub begins_line: bool,
}

impl LinePiece<'_> {
    /// Returns whether it begins as a [`Failure`](crate::Failure) does. A lambda and its libraries
    /// may write that, too.
    pub fn is_failure(&self) -> bool {
        self.begins_line && self.bytes.starts_with(b"error: ")
    }
}

/// Calls `take` with each piece of `from`, up to its end. Long lines are cut rather than held
/// whole. Returns whether the last line has a line break.
pub fn each_piece(from: impl Read, mut take: impl FnMut(LinePiece<'_>)) -> bool {
    let mut from = BufReader::new(from);
    let (mut bytes, mut begins_line) = (Vec::new(), true);
    while matches!((&mut from).take(PIECE_MAX).read_until(b'\n', &mut bytes), Ok(1..)) {
        take(LinePiece { bytes: &bytes, begins_line });
        begins_line = bytes.ends_with(b"\n");
        bytes.clear();
    }
    begins_line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_line_is_cut_into_pieces_and_only_the_first_begins_it() {
        let text = format!("one\n{}error: x\nlast", "y".repeat(2 * PIECE_MAX as usize));
        let mut pieces = Vec::new();
        let is_whole = each_piece(text.as_bytes(), |piece| {
            assert!(!piece.is_failure());
            pieces.push((piece.bytes.to_vec(), piece.begins_line));
        });
        assert!(
            !is_whole
                && each_piece(&b""[..], |_| {})
                && each_piece(&b"error: x\n"[..], |piece| assert!(piece.is_failure()))
        );
        assert_eq!(
            pieces.iter().flat_map(|(bytes, _)| bytes).copied().collect::<Vec<_>>(),
            text.as_bytes()
        );
        assert_eq!(
            pieces.iter().map(|(_, begins)| *begins).collect::<Vec<_>>(),
            [true, true, false, false, true]
        );
        assert!(pieces.iter().all(|(bytes, _)| bytes.len() as u64 <= PIECE_MAX));
    }
}
