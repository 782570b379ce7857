//! A small file that survives kills, power cuts and changed bytes: two copies, each with a
//! checksum, each replaced as a whole.

use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{
    ByteSize, DiskSteps, Exit, Failure, PlainFile, WriteSteps, hex, write_atomically_by,
};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

const MAX: ByteSize = ByteSize::mib(16);

/// A file with a value of type `T`.
#[derive(Debug)]
pub(crate) struct DurableFile {
    paths: [PathBuf; 2],
}

#[derive(Debug, PartialEq)]
pub(crate) struct Loaded<T> {
    /// The value; `None` if neither copy exists.
    pub(crate) value: Option<T>,
    /// The reasons why copies that exist were not used.
    pub(crate) damage: Option<String>,
}

impl DurableFile {
    /// Names the file `path`; its second copy is beside it.
    pub(crate) fn new(path: PathBuf) -> Self {
        let mut copy = path.clone().into_os_string();
        copy.push(".copy");
        Self { paths: [path, copy.into()] }
    }

    /// Reads the first copy, or the second one if that is lost or damaged. Such a copy is written
    /// again, if the disk has room.
    ///
    /// # Errors
    ///
    /// A failure if no copy can be used, and not both are absent.
    pub(crate) fn load<T: Serialize + DeserializeOwned>(&self) -> Result<Loaded<T>, Failure> {
        let copies = self.paths.each_ref().map(|path| read::<T>(path));
        let is_whole = copies.iter().all(|copy| matches!(copy, Ok(Some(_))));
        let errors = copies.iter().zip(&self.paths).filter_map(|(copy, path)| {
            Some(format!("`{}`: {}", path.display(), copy.as_ref().err()?))
        });
        let errors: Vec<_> = errors.collect();
        match copies.into_iter().find_map(|copy| copy.ok().flatten()) {
            None if errors.is_empty() => Ok(Loaded { value: None, damage: None }),
            None => {
                let path = self.paths[0].display();
                let mut failure = Failure::new(Exit::Internal, format!("`{path}` is damaged"));
                failure.causes = errors;
                let help = format!(
                    "check the disk, and restore `{path}` and `{path}.copy` from a backup; without \
                     one, remove both and deploy again: the vehicle then accepts releases that it \
                     had replaced"
                );
                Err(failure.with_help(help))
            }
            Some(value) => {
                if !is_whole {
                    // A full disk does not keep anything from running: the other copy is there.
                    let _ = self.save(&value);
                }
                let damage = (!errors.is_empty()).then(|| errors.join("; "));
                Ok(Loaded { value: Some(value), damage })
            }
        }
    }

    /// Writes `value` to both copies, durably.
    ///
    /// # Errors
    ///
    /// A failure that names the file. Either the former value or the new one is read afterwards.
    pub(crate) fn save(&self, value: &impl Serialize) -> Result<(), Failure> {
        self.save_by(&DiskSteps, value)
    }

    /// Removes both copies.
    ///
    /// # Errors
    ///
    /// A failure that names the file; it may be gone already.
    pub(crate) fn remove(&self) -> Result<(), Failure> {
        for path in &self.paths {
            match std::fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    let action = format!("cannot remove `{}`", path.display());
                    return Err(Failure::caused_by(Exit::Internal, action, &error));
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn save_by(&self, steps: &impl WriteSteps, value: &impl Serialize) -> Result<(), Failure> {
        let json = serde_json::to_string(value).expect("plain data");
        let text = format!("{}\n{json}\n", hex(&Sha256::digest(&json)));
        if text.len() as u64 > MAX.bytes() {
            let path = self.paths[0].display();
            let message = format!("`{path}` would have {} bytes, and may have {MAX}", text.len());
            return Err(Failure::new(Exit::Denied, message)
                .with_help("remove deployments first, or sign smaller ones"));
        }
        for path in &self.paths {
            write_atomically_by(steps, path, text.as_bytes()).map_err(|error| {
                let action = format!("cannot write `{}`", path.display());
                Failure::caused_by(Exit::Internal, action, &error)
                    .with_help("make room on the disk; what ran before goes on")
            })?;
        }
        Ok(())
    }
}

fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, String> {
    let bytes = match PlainFile::named(path, MAX).and_then(PlainFile::read_whole) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read.map_err(|error| error.to_string())?,
    };
    let text = String::from_utf8(bytes).map_err(|_| "it is not UTF-8".to_owned())?;
    let (digest, json) = text.split_once('\n').ok_or("it has no checksum")?;
    let json = json.strip_suffix('\n').ok_or("it has no end")?;
    if hex(&Sha256::digest(json)) != digest {
        return Err("its checksum is wrong".to_owned());
    }
    serde_json::from_str(json).map(Some).map_err(|error| error.to_string())
}

#[cfg(test)]
mod lossy_disk;
#[cfg(test)]
mod tests;
