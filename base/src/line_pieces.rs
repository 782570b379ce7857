//! What a program writes to standard error for people, as the program that started it passes it on.

use std::io::{BufRead, BufReader, Read};

/// Most bytes of a piece.
const PIECE_MAX: u64 = 8192;

/// A line, or a part of one that is longer than 8 KiB.
#[derive(Debug)]
pub struct LinePiece<'a> {
    /// Its bytes, with the end of the line if it has it.
    pub bytes: &'a [u8],
    /// It is the first of its line.
    pub begins_line: bool,
}

impl LinePiece<'_> {
    /// Whether it begins as a [`Failure`](crate::Failure) does. A lambda and its libraries may
    /// write that, too.
    pub fn is_failure(&self) -> bool {
        self.begins_line && self.bytes.starts_with(b"error: ")
    }
}

/// Gives `take` all that `from` has, to its end. A line is cut into pieces rather than held whole,
/// however long it is. Returns whether the last line has its end.
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
    fn a_line_comes_in_pieces_of_bounded_length_and_only_the_first_begins_it() {
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
