//! Whose file it is, by its first bytes.

use std::io::{self, BufReader, Read};
use std::path::Path;

use gleaner_base::safe_file;

/// Who wrote a file.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// A recorder, its header is whole.
    Ours,
    /// Nothing was written yet, or none of it reached the disk: empty, zeros, or cut off within our
    /// header.
    Nothing,
    /// Somebody else.
    Foreign,
}

/// Who wrote the file `path`.
pub(super) fn origin(path: &Path) -> io::Result<Origin> {
    let header = header();
    let mut file = BufReader::new(safe_file::read(path)?);
    let mut begin = Vec::new();
    file.by_ref().take(header.len() as u64).read_to_end(&mut begin)?;
    let is_ours = begin
        .iter()
        .zip(&header)
        .all(|(found, wanted)| wanted.is_none_or(|wanted| wanted == *found));
    if is_ours {
        return Ok(if begin.len() == header.len() { Origin::Ours } else { Origin::Nothing });
    }
    // After a power cut, a file may have its length and not its content.
    let mut is_zero = begin.iter().all(|byte| *byte == 0);
    let mut piece = [0; 4096];
    while is_zero {
        match file.read(&mut piece)? {
            0 => return Ok(Origin::Nothing),
            n => is_zero = piece[..n].iter().all(|byte| *byte == 0),
        }
    }
    Ok(Origin::Foreign)
}

/// How our files begin, up to the version; `None` for bytes that depend on it.
///
/// Source: the MCAP specification, version 0: magic, header record, its length, profile and
/// library.
fn header() -> Vec<Option<u8>> {
    let mut header: Vec<_> = b"\x89MCAP0\r\n\x01".iter().copied().map(Some).collect();
    header.extend([None; 8]);
    header.extend(b"\x04\0\0\0ros2".iter().copied().map(Some));
    header.extend([None; 4]);
    header.extend(b"gleaner ".iter().copied().map(Some));
    header
}
