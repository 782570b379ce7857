//! Wheels for tests, with entries that no tool would write.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use sha2::{Digest, Sha256};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

#[derive(Clone)]
pub(super) struct MadeWheel {
    name: String,
    files: Vec<(String, Vec<u8>)>,
    links: Vec<(String, String)>,
    record: String,
    has_record: bool,
}

impl MadeWheel {
    /// A wheel of `package` for any interpreter, without files.
    pub(super) fn new(package: &str) -> Self {
        Self::named(&format!("{package}-1.0-py3-none-any.whl"))
    }

    pub(super) fn named(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            files: Vec::new(),
            links: Vec::new(),
            record: String::new(),
            has_record: true,
        }
    }

    /// Adds a file, with its line in RECORD.
    pub(super) fn file(mut self, path: &str, content: impl AsRef<[u8]>) -> Self {
        let content = content.as_ref();
        let sha256 = URL_SAFE_NO_PAD.encode(Sha256::digest(content));
        self.record += &format!("{path},sha256={sha256},{}\n", content.len());
        self.unlisted(path, content)
    }

    /// Adds a file that RECORD does not list.
    pub(super) fn unlisted(mut self, path: &str, content: impl AsRef<[u8]>) -> Self {
        self.files.push((path.to_owned(), content.as_ref().to_owned()));
        self
    }

    pub(super) fn link(mut self, path: &str, target: &str) -> Self {
        self.links.push((path.to_owned(), target.to_owned()));
        self
    }

    pub(super) fn listed(mut self, text: &str) -> Self {
        self.record += text;
        self
    }

    pub(super) fn without_record(mut self) -> Self {
        self.has_record = false;
        self
    }

    pub(super) fn write(&self, folder: &Path) -> PathBuf {
        let path = folder.join(&self.name);
        let mut zip = ZipWriter::new(File::create(&path).unwrap());
        for (path, content) in &self.files {
            zip.start_file(path, SimpleFileOptions::default()).unwrap();
            zip.write_all(content).unwrap();
        }
        for (path, target) in &self.links {
            zip.add_symlink(path, target, SimpleFileOptions::default()).unwrap();
        }
        let package = self.name.split('-').next().unwrap();
        let info = format!("{package}-1.0.dist-info");
        zip.start_file(format!("{info}/METADATA"), SimpleFileOptions::default()).unwrap();
        let digest = URL_SAFE_NO_PAD.encode(Sha256::digest(""));
        if self.has_record {
            zip.start_file(format!("{info}/RECORD"), SimpleFileOptions::default()).unwrap();
            let record =
                format!("{}{info}/METADATA,sha256={digest},0\n{info}/RECORD,,\n", self.record);
            zip.write_all(record.as_bytes()).unwrap();
        }
        zip.finish().unwrap();
        path
    }
}
