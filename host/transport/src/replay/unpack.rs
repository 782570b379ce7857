//! Packed files: their content, in a file without a name.
//!
//! A packed file cannot be read from where one likes, and messages are not in the order of their times. So it is unpacked
//! once, to the disk, which has more room than memory.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use tempfile::{Builder, TempPath};
use tracing::warn;
use zstd::stream::read::Decoder;

use super::error::ReplayError;
use super::options::Options;
use super::source::Source;
use super::storage::{Kind, START};

/// Written at once.
const PIECE: usize = 1 << 20;

/// The content of a packed file.
pub(super) struct Unpacked {
    /// The packed file.
    pub(super) path: PathBuf,
    pub(super) file: File,
    /// As long as this is there, the content has a name, which a database needs to be opened.
    pub(super) name: TempPath,
    pub(super) len: u64,
    /// Why there is no more, though there should be.
    pub(super) broken: Option<io::Error>,
}

/// Unpacks what is in `source`, if it is something that we read. What that takes is taken from `room`, in bytes.
pub(super) fn unpack(source: Source, options: &Options, room: &mut u64) -> Result<Unpacked, ReplayError> {
    let path = source.path().to_owned();
    let folder = options.unpack_in.clone().unwrap_or_else(std::env::temp_dir);
    let failed = |source| ReplayError::Unpack { path: path.clone(), folder: folder.clone(), source };
    let mut packed = Decoder::new(source.into_file().map_err(failed)?).map_err(failed)?;
    let mut start = Vec::new();
    packed.by_ref().take(START as u64).read_to_end(&mut start).map_err(failed)?;
    // The rest is not even unpacked.
    if !matches!(Kind::of(&start), Some(Kind::Mcap | Kind::Database)) {
        return Err(ReplayError::NotMcap { path });
    }
    let (mut file, name) = new_file(&folder).map_err(failed)?;
    let mut content = start.as_slice().chain(packed);
    let (mut piece, mut len) = (vec![0; PIECE], 0);
    let broken = loop {
        match content.read(&mut piece) {
            Ok(0) => break None,
            Ok(n) => {
                len += n as u64;
                let Some(left) = room.checked_sub(n as u64) else {
                    return Err(ReplayError::UnpacksTooLarge { path, allowed: options.limits.unpacked_bytes });
                };
                *room = left;
                file.write_all(&piece[..n]).map_err(failed)?;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => {
                warn!(path = %path.display(), unpacked = len, %error, "drive can be unpacked only in part");
                break Some(error);
            }
        }
    };
    Ok(Unpacked { path, file, name, len, broken })
}

/// A new file in `folder`. A dot before its name: if the process is killed meanwhile, it is left.
fn new_file(folder: &Path) -> io::Result<(File, TempPath)> {
    Ok(Builder::new().prefix(".unpacked-").tempfile_in(folder)?.into_parts())
}
