//! `lambda.toml`: read once, and turned into types that cannot be wrong, so that no later code has to check again.
//!
//! `table` and `value` walk the document, `read` says what each key is, `error` what a user sees when one is refused: the
//! file, the line, the key, the cause and the way out. Nothing here looks at the file system except to read the
//! manifest itself: whether `entry` exists is the business of [`layout`](crate::layout).

pub mod bounds;
mod config;
mod error;
mod names;
mod read;
mod read_config;
mod syntax;
mod table;
#[cfg(test)]
mod tests;
mod types;
mod units;
mod value;

pub use config::{ConfigError, ConfigItem, ConfigSet, ConfigValue};
pub use error::{InputMemory, ManifestError, Place};
pub use names::{ItemName, LambdaName, NameError, RelativePath, Sha256, TopicName, TypeName, Version};
pub use types::{
    Backlog, Durability, Input, Kind, Lambda, Limits, Manifest, Model, Qos, Record, Reliability, Schedule, Store,
};
pub use units::{ByteSize, UnitError, format_duration, parse_duration};

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

impl Manifest {
    /// The manifest that `text` holds. `file` is its name in messages, usually `lambda.toml`.
    ///
    /// # Errors
    ///
    /// The first problem that is found; the text is read table by table.
    pub fn parse(text: &str, file: impl AsRef<Path>) -> Result<Manifest, ManifestError> {
        let file = file.as_ref().display().to_string();
        read::manifest(&table::Document { text, file: &file })
    }

    /// The manifest in the folder `dir`: a lambda's own, or that of its build folder.
    ///
    /// # Errors
    ///
    /// As [`parse`](Self::parse), and if `dir/lambda.toml` cannot be read, is longer than
    /// [`MANIFEST_MAX`](bounds::MANIFEST_MAX), or is no UTF-8.
    pub fn load(dir: impl AsRef<Path>) -> Result<Manifest, ManifestError> {
        let path = dir.as_ref().join("lambda.toml");
        let limit = bounds::MANIFEST_MAX;
        let read = || -> io::Result<Vec<u8>> {
            let mut bytes = Vec::new();
            // One byte more than allowed is enough to know.
            File::open(&path)?.take(limit.bytes() + 1).read_to_end(&mut bytes)?;
            Ok(bytes)
        };
        let bytes = read().map_err(|source| ManifestError::Read { path: path.clone(), source })?;
        if bytes.len() > limit.as_usize() {
            return Err(ManifestError::TooLong { path, limit });
        }
        match String::from_utf8(bytes) {
            Ok(text) => Manifest::parse(&text, &path),
            Err(error) => Err(ManifestError::Read {
                path,
                source: io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()),
            }),
        }
    }
}
