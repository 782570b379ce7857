//! Parses `lambda.toml` and `vehicle.toml` once, into types that are valid by construction, so that
//! no later code has to check again.
//!
//! `table` and `value` walk the document, `read` parses each key, and `error` has the messages of a
//! refusal: the file, the line, the key, the cause and help. The file system is used only to read
//! the manifest itself: [`layout`](crate::layout) checks whether `entry` exists.

pub mod bounds;
mod config;
mod error;
mod generated;
mod limit;
mod limits;
mod names;
mod read;
mod read_config;
mod read_demand;
mod read_vehicle;
mod reference;
mod syntax;
mod table;
#[cfg(test)]
mod tests;
mod types;
mod value;
mod vehicle;

pub use config::{ConfigError, ConfigItem, ConfigSet, ConfigValue};
pub use error::{InputMemory, KeyLocation, ManifestError};
pub use generated::{GENERATED, Generated};
use gleaner_base::{ByteSize, UnitError, format_duration, parse_duration};
pub use limits::{Limits, Tightened};
pub use names::{
    ItemName, LambdaName, NameError, RelativePath, Sha256, TopicName, TypeName, Version,
};
pub use reference::reference;
pub use types::{
    Backlog, Demand, Durability, InputSpec, LambdaKind, LambdaSection, Manifest, ModelSpec, Qos,
    RecordSpec, Reliability, ScheduleSpec, Store,
};
pub use vehicle::{
    DeploymentSettings, InferenceLimits, MetricsSettings, NetworkSettings, RecordingSettings,
    Vehicle, VehicleIdentity,
};

use std::io;
use std::path::Path;

use gleaner_base::{NotPlain, PlainFile};

pub const MANIFEST_FILE: &str = "lambda.toml";

impl Manifest {
    /// Parses the manifest `text`. `file` is its name in messages, usually `lambda.toml`.
    ///
    /// # Errors
    ///
    /// The first problem that is found; the text is read table by table.
    pub fn parse(text: &str, file: impl AsRef<Path>) -> Result<Manifest, ManifestError> {
        let file = file.as_ref().display().to_string();
        read::manifest(&table::Document { text, file: &file })
    }

    /// Loads the manifest in `dir`, the folder of a lambda or its build folder.
    ///
    /// # Errors
    ///
    /// As [`parse`](Self::parse) and [`read`](Self::read).
    pub fn load(dir: impl AsRef<Path>) -> Result<Manifest, ManifestError> {
        let dir = dir.as_ref();
        Manifest::parse(&Manifest::read(dir)?, dir.join(MANIFEST_FILE))
    }

    /// Reads the text of the manifest in the folder `dir`, for callers that need its bytes as well.
    ///
    /// # Errors
    ///
    /// If `dir/lambda.toml` cannot be read, is not a file of that folder, is longer than
    /// [`MANIFEST_MAX`](bounds::MANIFEST_MAX), or is not UTF-8.
    pub fn read(dir: impl AsRef<Path>) -> Result<String, ManifestError> {
        let dir = dir.as_ref();
        text(
            &dir.join(MANIFEST_FILE),
            PlainFile::inside(dir, Path::new(MANIFEST_FILE), bounds::MANIFEST_MAX),
        )
    }
}

/// Reads a file in the format of a manifest, which a user has named.
fn read_text(path: &Path) -> Result<String, ManifestError> {
    text(path, PlainFile::named(path, bounds::MANIFEST_MAX))
}

fn text(path: &Path, opened: io::Result<PlainFile>) -> Result<String, ManifestError> {
    let path = || path.to_owned();
    let bytes =
        opened.and_then(PlainFile::read_whole).map_err(|source| match NotPlain::of(&source) {
            Some(NotPlain::TooLong { most, .. }) => {
                ManifestError::TooLong { path: path(), limit: *most }
            }
            _ => ManifestError::Read { path: path(), source },
        })?;
    String::from_utf8(bytes).map_err(|error| {
        let source = io::Error::new(io::ErrorKind::InvalidData, error.utf8_error());
        ManifestError::Read { path: path(), source }
    })
}
