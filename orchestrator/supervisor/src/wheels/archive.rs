//! Reads a wheel: a zip archive whose RECORD lists each file with its digest.
//!
//! All names, lengths and digests are checked before a file is used, and nothing is written outside
//! of the given writer.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use gleaner_base::{ByteSize, PlainFile};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::RelativePath;
use sha2::{Digest, Sha256};
use zip::ZipArchive;
use zip::result::ZipError;

use crate::wheels::{WheelError, WheelName};

/// Maximum number of files in all wheels of a lambda: numpy has a thousand, PyTorch ten thousand.
pub(super) const FILES_MAX: usize = 50_000;

/// Maximum length of all files in all wheels of a lambda.
pub(super) const UNPACKED_MAX: ByteSize = ByteSize::gib(4);

/// Longest RECORD, and longest file that it does not list.
const RECORD_MAX: u64 = 16 << 20;

/// The files beside RECORD that it need not list: signatures, which nothing checks.
const UNLISTED: [&str; 3] = ["RECORD", "RECORD.jws", "RECORD.p7s"];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FileDigest {
    pub(super) bytes: u64,
    pub(super) sha256: [u8; 32],
}

#[derive(Debug, PartialEq)]
pub(super) struct WheelFile {
    index: usize,
    /// Its path in the folder of packages.
    pub(super) path: PathBuf,
    pub(super) digest: FileDigest,
}

#[derive(Debug)]
pub(super) struct WheelArchive {
    pub(super) name: WheelName,
    archive: ZipArchive<BufReader<File>>,
    pub(super) files: Vec<WheelFile>,
}

/// Checks the wheel `path` completely, as it is unpacked on a vehicle. Returns its name.
///
/// # Errors
///
/// [`WheelError`] with the first entry that is refused.
pub fn check(path: &Path) -> Result<WheelName, WheelError> {
    let mut wheel = WheelArchive::open(path)?;
    merged([(wheel.name.as_str(), &*wheel.files)])?;
    for number in 0..wheel.files.len() {
        wheel.copy(number, &mut io::sink())?;
    }
    Ok(wheel.name)
}

/// Returns the files of wheels by their paths in the folder of packages, each with its digest and
/// the number of the last wheel that has it. The wheels are given with their names. Different files
/// of one name, or a file and a folder, are refused.
pub(super) fn merged<'w>(
    wheels: impl IntoIterator<Item = (&'w str, &'w [WheelFile])>,
) -> Result<BTreeMap<&'w Path, (FileDigest, usize)>, WheelError> {
    let (mut files, mut names) = (BTreeMap::new(), Vec::new());
    let wheel = |names: &[&str], number: usize| names[number].to_owned();
    for (number, (name, of_wheel)) in wheels.into_iter().enumerate() {
        names.push(name);
        for file in of_wheel {
            let before = files.insert(&*file.path, (file.digest, number));
            // Packages of one namespace may have the same `__init__.py`.
            if let Some((_, first)) = before.filter(|(other, _)| *other != file.digest) {
                let (first, second) = (wheel(&names, first), wheel(&names, number));
                let entry = file.path.to_string_lossy().into_owned();
                return Err(WheelError::Conflict { first, second, entry });
            }
        }
    }
    // What is in a folder follows a file of its name.
    for ((file, (_, first)), (path, (_, second))) in files.iter().zip(files.iter().skip(1)) {
        if path.starts_with(file) {
            let (first, second) = (wheel(&names, *first), wheel(&names, *second));
            let entry = file.to_string_lossy().into_owned();
            return Err(WheelError::FileAndFolder { first, second, entry });
        }
    }
    Ok(files)
}

impl WheelArchive {
    /// Opens the wheel `path`, and checks the names and lengths of its files.
    pub(super) fn open(path: &Path) -> Result<Self, WheelError> {
        let name: WheelName =
            path.file_name().unwrap_or_default().to_string_lossy().parse::<WheelName>()?;
        let failed = |source| WheelError::Read { path: path.to_owned(), source };
        let file = PlainFile::named(path, FILE_MAX).map_err(failed)?.into_file();
        let archive = ZipArchive::new(BufReader::new(file)).map_err(of_archive(&name))?;
        let mut wheel = Self { name, archive, files: Vec::new() };
        let entries = wheel.entries()?;
        wheel.files = wheel.installed(&entries)?;
        Ok(wheel)
    }

    /// Returns the paths and lengths of its files, by their numbers in the archive.
    fn entries(&mut self) -> Result<BTreeMap<usize, (String, u64)>, WheelError> {
        let (mut entries, mut folders) = (BTreeMap::new(), BTreeSet::new());
        let mut left = UNPACKED_MAX.bytes();
        if self.archive.len() > FILES_MAX {
            return Err(self.too_much());
        }
        for index in 0..self.archive.len() {
            let entry = self.archive.by_index_raw(index).map_err(of_archive(&self.name))?;
            let text = entry.name().to_owned();
            let refused = |reason| Err(self.name.refused(&text, reason));
            let path = if entry.is_dir() { text.trim_end_matches('/') } else { &text };
            if path.parse::<RelativePath>().is_err() {
                return refused("a path has to lead into the folder of packages");
            }
            if gleaner_base::visible(path) != path {
                return refused("a path has to be text that a terminal shows as it is");
            }
            if entry.is_symlink() {
                return refused("links are not unpacked");
            }
            if entry.encrypted() {
                return refused("it is encrypted");
            }
            if entry.is_dir() {
                folders.insert(path.to_owned());
                continue;
            }
            let bytes = entry.size();
            drop(entry);
            left = left.checked_sub(bytes).ok_or_else(|| self.too_much())?;
            entries.insert(index, (text, bytes));
        }
        if let Some((text, _)) = entries.values().find(|(text, _)| folders.contains(text)) {
            return Err(self.name.refused(text, "a folder of the same name"));
        }
        Ok(entries)
    }

    /// Returns the files that an environment gets: those at the top and those for Python's folders.
    /// Scripts, headers and data are left out, since a lambda starts no programs.
    fn installed(
        &mut self,
        entries: &BTreeMap<usize, (String, u64)>,
    ) -> Result<Vec<WheelFile>, WheelError> {
        let top = |path: &str| path.split_once('/').map(|(top, _)| top.to_owned());
        let tops: BTreeSet<_> = entries.values().filter_map(|(path, _)| top(path)).collect();
        let info: Vec<_> = tops.iter().filter(|top| top.ends_with(".dist-info")).collect();
        let [info] = info[..] else {
            return Err(self.name.no_record("it has not exactly one folder .dist-info"));
        };
        let unlisted = UNLISTED.map(|name| format!("{info}/{name}"));
        let listed = self.record(entries, &unlisted[0])?;
        let mut files = Vec::new();
        for (&index, (entry, bytes)) in entries {
            let data = entry.split_once('/').filter(|(top, _)| top.ends_with(".data"));
            let path = match data.map(|(_, rest)| rest.split_once('/')) {
                None => entry,
                Some(Some(("purelib" | "platlib", path))) => path,
                Some(Some(("scripts" | "headers" | "data", _))) => continue,
                Some(_) => {
                    let reason = "a folder .data has only purelib, platlib, scripts, headers, data";
                    return Err(self.name.refused(entry, reason));
                }
            };
            let digest = match listed.get(entry) {
                Some(digest) if digest.bytes == *bytes => *digest,
                Some(_) => return Err(self.name.differs(entry)),
                None if unlisted.contains(entry) => {
                    let text = self.read_short(index, entry)?;
                    FileDigest { bytes: *bytes, sha256: Sha256::digest(&text).into() }
                }
                None => return Err(self.name.no_record(&format!("it does not list `{entry}`"))),
            };
            files.push(WheelFile { index, path: path.into(), digest });
        }
        // One that is at the top and in Python's folder is unpacked once.
        files.sort_by(|a, b| a.path.cmp(&b.path));
        files.dedup_by(|a, b| (&a.path, a.digest) == (&b.path, b.digest));
        Ok(files)
    }

    /// Reads RECORD: the digests of the files that it lists.
    fn record(
        &mut self,
        entries: &BTreeMap<usize, (String, u64)>,
        record: &str,
    ) -> Result<BTreeMap<String, FileDigest>, WheelError> {
        let found = entries.iter().find(|(_, (path, _))| path == record).map(|(index, _)| *index);
        let index = found.ok_or_else(|| self.name.no_record("there is none"))?;
        let text = self.read_short(index, record)?;
        let mut rows =
            csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(&*text);
        let mut listed = BTreeMap::new();
        for row in rows.records() {
            let row = row.map_err(|error| self.name.no_record(&error.to_string()))?;
            let [path, digest, bytes] = [0, 1, 2].map(|at| row.get(at).unwrap_or(""));
            if digest.is_empty() {
                continue;
            }
            let parse = || {
                let sha256 = URL_SAFE_NO_PAD.decode(digest.strip_prefix("sha256=")?).ok()?;
                Some(FileDigest { bytes: bytes.parse().ok()?, sha256: sha256.try_into().ok()? })
            };
            let parsed = parse().ok_or_else(|| {
                let path = gleaner_base::excerpt(path);
                self.name.no_record(&format!("the line of `{path}` has no SHA-256 and length"))
            })?;
            // The archive has two entries of the name then, of which the reader skips one.
            if listed.insert(path.to_owned(), parsed).is_some_and(|other| other != parsed) {
                let path = gleaner_base::excerpt(path);
                return Err(self.name.no_record(&format!("it lists `{path}` twice")));
            }
        }
        Ok(listed)
    }

    /// Reads an entry that no digest covers.
    fn read_short(&mut self, index: usize, entry: &str) -> Result<Vec<u8>, WheelError> {
        let mut text = Vec::new();
        let reader = self.archive.by_index(index).map_err(of_archive(&self.name))?;
        let bytes = reader.size();
        let read = reader.take(RECORD_MAX + 1).read_to_end(&mut text);
        match read.map_err(|it| of_archive(&self.name)(it.into()))? as u64 == bytes {
            true if bytes <= RECORD_MAX => Ok(text),
            _ => Err(self.name.refused(entry, "its length is not that of its entry, or too large")),
        }
    }

    /// Writes the file with this number in [`files`](Self::files) to `into`. What was written
    /// counts only without an error.
    pub(super) fn copy(&mut self, number: usize, into: &mut impl Write) -> Result<(), WheelError> {
        let WheelFile { index, path, digest } = &self.files[number];
        let failed = of_archive(&self.name);
        let reader = self.archive.by_index(*index).map_err(&failed)?;
        // One byte more, to notice a longer one.
        let mut reader = reader.take(digest.bytes + 1);
        let (mut sha256, mut bytes) = (Sha256::new(), 0);
        let mut piece = vec![0; 64 << 10];
        loop {
            let read = reader.read(&mut piece).map_err(|error| failed(error.into()))?;
            if read == 0 {
                break;
            }
            bytes += read as u64;
            sha256.update(&piece[..read]);
            into.write_all(&piece[..read]).map_err(|source| WheelError::Unpack {
                wheel: self.name.as_str().to_owned(),
                source,
            })?;
        }
        match (FileDigest { bytes, sha256: sha256.finalize().into() }) == *digest {
            true => Ok(()),
            false => Err(self.name.differs(&path.to_string_lossy())),
        }
    }

    pub(super) fn too_much(&self) -> WheelError {
        WheelError::TooMuch { wheel: self.name.as_str().to_owned() }
    }
}

impl WheelName {
    fn refused(&self, entry: &str, reason: &'static str) -> WheelError {
        let (wheel, entry) = (self.as_str().to_owned(), gleaner_base::excerpt(entry));
        WheelError::Entry { wheel, entry, reason }
    }

    fn no_record(&self, reason: &str) -> WheelError {
        WheelError::Record { wheel: self.as_str().to_owned(), reason: reason.to_owned() }
    }

    fn differs(&self, entry: &str) -> WheelError {
        WheelError::Differs { wheel: self.as_str().to_owned(), entry: entry.to_owned() }
    }
}

fn of_archive(name: &WheelName) -> impl Fn(ZipError) -> WheelError + use<> {
    let wheel = name.as_str().to_owned();
    move |source| WheelError::Archive { wheel: wheel.clone(), source }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wheels::made_wheel::MadeWheel;

    fn plain() -> MadeWheel {
        MadeWheel::new("plain").file("plain/__init__.py", "ANSWER = 42\n")
    }

    #[test]
    fn a_wheel_has_its_packages_but_no_scripts() {
        let folder = tempfile::tempdir().unwrap();
        let wheel = plain()
            .file("plain-1.0.data/purelib/pure.py", "")
            .file("plain-1.0.data/platlib/native/x.so", "")
            .file("plain-1.0.data/scripts/plain", "#!python")
            .file("plain-1.0.data/data/share/x", "")
            .write(folder.path());
        let opened = WheelArchive::open(&wheel).unwrap();
        let mut paths: Vec<_> = opened.files.iter().map(|it| it.path.to_str().unwrap()).collect();
        paths.sort_unstable();
        let info = ["plain-1.0.dist-info/METADATA", "plain-1.0.dist-info/RECORD"];
        assert_eq!(
            paths,
            [&["native/x.so"], &info[..], &["plain/__init__.py", "pure.py"]].concat()
        );
        assert_eq!(check(&wheel).unwrap().distribution(), "plain");
    }

    #[test]
    fn what_could_leave_the_folder_or_is_not_as_listed_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let good = |text: &str| URL_SAFE_NO_PAD.encode(Sha256::digest(text));
        for (wheel, part) in [
            (plain().file("../x.py", ""), "the entry `../x.py`"),
            (plain().file("plain/../../x.py", ""), "the entry `plain/../../x.py`"),
            (plain().file("/etc/x.py", ""), "the entry `/etc/x.py`"),
            (plain().file("plain\\x.py", ""), "the entry `plain\\x.py`"),
            (plain().file("plain-1.0.data/purelib/../../x", ""), "has to lead into"),
            (plain().file("plain/\u{202e}x.py", ""), r"the entry `plain/\u{202e}x.py`"),
            (plain().file("odd", "").file("odd/x.py", ""), "has a file and a folder `odd`"),
            (plain().file("odd", "").unlisted("odd/", ""), "the entry `odd`, and a folder"),
            (plain().link("plain/key", "/etc/passwd"), "links are not unpacked"),
            (plain().unlisted("plain/more.py", ""), "it does not list `plain/more.py`"),
            (
                plain()
                    .unlisted("plain/x.py", "bad!")
                    .listed(&format!("plain/x.py,sha256={},4\n", good("good"))),
                "file `plain/x.py` of wheel `plain-1.0-py3-none-any.whl` is not as",
            ),
            (
                plain()
                    .unlisted("plain/x.py", "longer")
                    .listed(&format!("plain/x.py,sha256={},4\n", good("good"))),
                "is not as its RECORD",
            ),
            (
                plain().unlisted("plain/x.py", "").listed("plain/x.py,md5=abc,0\n"),
                "the line of `plain/x.py` has no SHA-256",
            ),
            (plain().file("plain-1.0.data/lib/x.py", ""), "the entry `plain-1.0.data/lib/x.py`"),
            (plain().file("plain-1.0.data/purelib", ""), "a folder .data has only"),
            (plain().without_record(), "there is none"),
            (plain().file("other-2.dist-info/METADATA", ""), "not exactly one folder .dist-info"),
        ] {
            let error = check(&wheel.write(folder.path())).unwrap_err();
            let text = gleaner_base::Failure::from(error).to_string();
            assert!(text.contains(part) && text.contains("help:"), "{part}: {text}");
        }
    }

    /// Changes the length in both headers of each entry that has it; returns the archive.
    fn state_length(path: &Path, length: u32, stated: u32) -> Vec<u8> {
        let mut bytes = std::fs::read(path).unwrap();
        for at in 0..bytes.len() - 4 {
            if bytes[at..at + 4] == length.to_le_bytes() {
                bytes[at..at + 4].copy_from_slice(&stated.to_le_bytes());
            }
        }
        std::fs::write(path, &bytes).unwrap();
        bytes
    }

    #[test]
    fn an_archive_that_is_longer_than_it_states_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let wheel = plain().file("plain/zeros", vec![0; 1 << 20]);
        let path = wheel.write(folder.path());
        state_length(&path, 1 << 20, 10);
        check(&path).unwrap_err();
        // A bomb states its length: it is refused before it is unpacked.
        wheel.write(folder.path());
        let bytes = state_length(&path, 1 << 20, u32::MAX - 1);
        check(&path).unwrap_err();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let text = check(&path).unwrap_err().to_string();
        assert!(text.contains("is not a zip archive"), "{text}");
    }

    #[test]
    fn wheels_of_more_than_the_bound_are_refused_before_they_are_unpacked() {
        let folder = tempfile::tempdir().unwrap();
        let mut wheel = plain();
        for number in 0..5 {
            wheel = wheel.file(&format!("plain/zeros{number}"), vec![0; 1 << 10]);
        }
        let path = wheel.write(folder.path());
        state_length(&path, 1 << 10, 1 << 30);
        let error = WheelArchive::open(&path).unwrap_err();
        assert!(matches!(error, WheelError::TooMuch { .. }), "{error}");
    }

    #[test]
    fn a_wheel_with_a_changed_or_missing_byte_is_refused_or_has_the_same_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = plain().write(folder.path());
        let files = |path: &Path| {
            check(path)?;
            let files = WheelArchive::open(path)?.files.into_iter();
            Ok::<_, WheelError>(
                files.map(|file| (file.path, file.digest.sha256)).collect::<Vec<_>>(),
            )
        };
        let (whole, expected) = (std::fs::read(&path).unwrap(), files(&path).unwrap());
        let mut refused = 0;
        for at in 0..whole.len() {
            for change in [0x01, 0x80, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] ^= change;
                std::fs::write(&path, &bytes).unwrap();
                match files(&path) {
                    Ok(found) => assert_eq!(found, expected, "byte {at}"),
                    Err(_) => refused += 1,
                }
            }
            std::fs::write(&path, &whole[..at]).unwrap();
            assert!(files(&path).is_err(), "{at} bytes");
        }
        assert!(refused > whole.len());
    }
}
