//! Detects the writer of a file by its first bytes.

use std::io::{self, BufReader, Read};
use std::path::Path;

use gleaner_base::safe_file;

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// A recorder; its header is complete.
    Recorder,
    /// Unknown: nothing was written yet, or none of it reached the disk. The file is empty, zeros,
    /// or truncated within our header.
    Nothing,
    Foreign,
}

pub(super) fn origin(path: &Path) -> io::Result<Origin> {
    let header = header();
    let mut file = BufReader::new(safe_file::read(path)?);
    let mut begin = Vec::new();
    file.by_ref().take(header.len() as u64).read_to_end(&mut begin)?;
    let is_recorder = begin
        .iter()
        .zip(&header)
        .all(|(found, wanted)| wanted.is_none_or(|wanted| wanted == *found));
    if is_recorder {
        return Ok(if begin.len() == header.len() { Origin::Recorder } else { Origin::Nothing });
    }
    // After a power failure, a file may have its length but not its content.
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

/// Returns the first bytes of our files, up to the version; `None` for bytes that depend on it.
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
