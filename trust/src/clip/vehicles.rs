//! The vehicles whose clips a reader trusts: a text file with a name and a public key in each line.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gleaner_base::{ByteSize, Exit, Explain, NotPlain, PlainFile, excerpt};
use serde::Serialize;

use crate::PublicKey;

/// Longest file; a line with a long name and a key has 110 bytes.
const FILE_MAX: ByteSize = ByteSize::mib(1);
/// Longest name of a vehicle, in bytes.
const NAME_MAX: usize = 64;

/// Name of a vehicle: 1 to 64 letters of ASCII, digits, `.`, `_` and `-`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct VehicleName(String);

impl VehicleName {
    /// Returns the name of this machine.
    ///
    /// # Errors
    ///
    /// The reason why a vehicle cannot have this name.
    pub fn of_machine() -> Result<Self, String> {
        rustix::system::uname().nodename().to_string_lossy().parse()
    }
}

impl FromStr for VehicleName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        match (1..=NAME_MAX).contains(&text.len()) && text.chars().all(allowed) {
            true => Ok(Self(text.to_owned())),
            false => Err(format!(
                "`{}` is not the name of a vehicle: 1 to {NAME_MAX} letters, digits, `.`, `_` and \
                 `-`, as in car-7",
                excerpt(text)
            )),
        }
    }
}

impl fmt::Display for VehicleName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The vehicles whose clips are trusted, each with its key. One may have several keys, of which a
/// former one still counts for earlier clips.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TrustedVehicles(Vec<(VehicleName, PublicKey)>);

impl TrustedVehicles {
    /// Loads the file `path`.
    ///
    /// # Errors
    ///
    /// [`VehiclesError`].
    pub fn load(path: &Path) -> Result<Self, VehiclesError> {
        let path = path.to_owned();
        let text = PlainFile::named(&path, FILE_MAX).and_then(PlainFile::read_whole);
        let text = match text {
            Ok(text) => text,
            Err(source) => return Err(VehiclesError::Read { path, source }),
        };
        Self::parse(&text).map_err(|(line, reason)| VehiclesError::Line { path, line, reason })
    }

    /// Parses the content of such a file; the error is the number of a line, and the reason.
    ///
    /// # Errors
    ///
    /// A line that is neither empty, nor a comment, nor a name and a key.
    pub fn parse(text: &[u8]) -> Result<Self, (usize, String)> {
        let mut vehicles = Vec::new();
        for (index, line) in text.split(|byte| *byte == b'\n').enumerate() {
            let wrong = |reason: String| (index + 1, reason);
            let line = str::from_utf8(line).map_err(|_| wrong("it is not UTF-8".to_owned()))?;
            let line = line.split('#').next().unwrap_or_default();
            match line.split_ascii_whitespace().collect::<Vec<_>>()[..] {
                [] => {}
                [name, key] => {
                    vehicles.push((name.parse().map_err(wrong)?, key.parse().map_err(wrong)?));
                }
                _ => return Err(wrong("it has not the form NAME PUBLICKEY".to_owned())),
            }
        }
        Ok(Self(vehicles))
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &PublicKey> {
        self.0.iter().map(|(_, key)| key)
    }

    pub(super) fn named(&self, id: &str) -> impl Iterator<Item = &VehicleName> {
        self.0.iter().filter(move |(_, key)| key.id() == *id).map(|(name, _)| name)
    }
}

/// The reason why a list of vehicles cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum VehiclesError {
    #[error("cannot read the list of vehicles `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("line {line} of the list of vehicles `{}` is wrong: {reason}", path.display())]
    Line { path: PathBuf, line: usize, reason: String },
}

impl Explain for VehiclesError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Read { source, .. } => NotPlain::of(source)
                .map_or("name a file that you can read".to_owned(), NotPlain::help),
            Self::Line { .. } => {
                "write NAME PUBLICKEY, with the public key that `gleaner keys show KEY` prints"
                    .to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SecretKey;

    #[test]
    fn a_list_of_vehicles_has_a_name_and_a_key_in_each_line() {
        let [a, b] = [1, 2].map(|seed| SecretKey::from_bytes(&[seed; 32]).public());
        let text = format!("# cars\n\ncar-7 {a}\r\n  Car_8.x\t{b}  # new\ncar-7 {b}");
        let vehicles = TrustedVehicles::parse(text.as_bytes()).unwrap();
        let named = |key: &PublicKey| {
            vehicles.named(key.id().as_str()).map(ToString::to_string).collect::<Vec<_>>()
        };
        assert_eq!(named(&a), ["car-7"]);
        assert_eq!(named(&b), ["Car_8.x", "car-7"]);
        assert_eq!(vehicles.keys().count(), 3);
    }

    #[test]
    fn a_wrong_line_of_a_list_of_vehicles_is_named() {
        let key = SecretKey::from_bytes(&[1; 32]).public();
        for (line, reason) in [
            ("car-7".to_owned(), "NAME PUBLICKEY"),
            (format!("car-7 {key} {key}"), "NAME PUBLICKEY"),
            (format!("car/7 {key}"), "is not the name of a vehicle"),
            (format!("{} {key}", "x".repeat(65)), "is not the name of a vehicle"),
            (format!("car-7 {}", &key.to_string()[1..]), "is not an ed25519 public key"),
        ] {
            let (number, found) =
                TrustedVehicles::parse(format!("#\n{line}\n").as_bytes()).unwrap_err();
            assert!(number == 2 && found.contains(reason) && found.len() < 300, "{found}");
        }
        assert_eq!(TrustedVehicles::parse(b"\xff").unwrap_err().0, 1);
    }
}
