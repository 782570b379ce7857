//! A small file that survives kills, power cuts and changed bytes: two copies, each with a
//! checksum, each replaced as a whole.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, hex, write_atomically};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

/// Maximum length of such a file.
const MAX: ByteSize = ByteSize::mib(16);

/// A file with a value of type `T`.
#[derive(Debug)]
pub(crate) struct DurableFile {
    paths: [PathBuf; 2],
}

/// A value that was read.
#[derive(Debug, PartialEq)]
pub(crate) struct Loaded<T> {
    /// The value; `None` if neither copy exists.
    pub(crate) value: Option<T>,
    /// The reason why the first copy was not used, if it exists.
    pub(crate) damage: Option<String>,
}

impl DurableFile {
    /// Names the file `path`; its second copy is beside it.
    pub(crate) fn new(path: PathBuf) -> Self {
        let mut copy = path.clone().into_os_string();
        copy.push(".copy");
        Self { paths: [path, copy.into()] }
    }

    /// Reads the first copy, or the second one if that is damaged.
    ///
    /// # Errors
    ///
    /// A failure if all existing copies are damaged.
    pub(crate) fn load<T: DeserializeOwned>(&self) -> Result<Loaded<T>, Failure> {
        let [first, second] = self.paths.each_ref().map(|path| read(path));
        match (first, second) {
            (Ok(None), Ok(value)) => Ok(Loaded { value, damage: None }),
            (Ok(value), _) => Ok(Loaded { value, damage: None }),
            (Err(damage), Ok(Some(value))) => {
                Ok(Loaded { value: Some(value), damage: Some(damage) })
            }
            (Err(damage), _) => {
                let path = self.paths[0].display();
                let mut failure = Failure::new(Exit::Internal, format!("`{path}` is damaged"));
                failure.causes = vec![damage];
                let help = format!(
                    "restore `{path}` and `{path}.copy` from a backup; without one, remove both and \
                     deploy again: the vehicle then accepts releases that it had replaced"
                );
                Err(failure.with_help(help))
            }
        }
    }

    /// Writes `value` to both copies, durably.
    ///
    /// # Errors
    ///
    /// A failure that names the file. Either the former value or the new one is read afterwards.
    pub(crate) fn save(&self, value: &impl Serialize) -> Result<(), Failure> {
        let json = serde_json::to_string(value).expect("plain data");
        let text = format!("{}\n{json}\n", hex(&Sha256::digest(&json)));
        for path in &self.paths {
            write_atomically(path, text.as_bytes()).map_err(|error| {
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

/// Makes the entries of `folder` durable.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    fs::File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(folder: &tempfile::TempDir) -> DurableFile {
        DurableFile::new(folder.path().join("state.json"))
    }

    #[test]
    fn any_changed_byte_and_any_cut_of_one_copy_is_found_and_the_other_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = file(&folder);
        assert_eq!(file.load::<Vec<u32>>().unwrap(), Loaded { value: None, damage: None });
        file.save(&vec![1, 22, 333]).unwrap();
        let whole = fs::read(&file.paths[0]).unwrap();
        let load = || file.load::<Vec<u32>>();
        for at in 0..whole.len() {
            let mut changed = whole.clone();
            changed[at] ^= 1;
            for damaged in [&changed, &whole[..at]] {
                fs::write(&file.paths[0], damaged).unwrap();
                let loaded = load().unwrap();
                assert_eq!(loaded.value, Some(vec![1, 22, 333]), "{at}");
                assert!(loaded.damage.is_some(), "{at}");
                fs::write(&file.paths[1], damaged).unwrap();
                assert!(load().unwrap_err().to_string().contains("is damaged"), "{at}");
                fs::write(&file.paths[1], &whole).unwrap();
            }
        }
        fs::remove_file(&file.paths[0]).unwrap();
        assert_eq!(load().unwrap().value, Some(vec![1, 22, 333]), "the first copy was lost");
    }

    #[test]
    fn a_value_that_cannot_be_written_leaves_the_former_one() {
        let folder = tempfile::tempdir().unwrap();
        let file = file(&folder);
        file.save(&1).unwrap();
        fs::create_dir(folder.path().join("state.json.part")).unwrap();
        file.save(&2).unwrap_err();
        assert_eq!(file.load::<u32>().unwrap().value, Some(1));
    }
}
