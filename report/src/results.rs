//! Reads the JSON lines files of a run: `decisions.jsonl`, `clips.jsonl`, `log.jsonl`.
//!
//! Files are read line by line, since `decisions.jsonl` may have a line per wake. Nothing is
//! written.

use std::io::{self, BufRead, BufReader, Read};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use gleaner_base::{Explain, PlainFile};
use gleaner_lambda::results::{LINE_MAX, LINES_MAX};
use gleaner_lambda::{Clip, Decision};
use serde::de::DeserializeOwned;

#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("`{}`, line {line}, is not a line that gleaner writes", path.display())]
    Line {
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        source: serde_json::Error,
    },
    #[error("`{}`, line {line}, is longer than {LINE_MAX}", path.display())]
    Long {
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
}

impl Explain for ResultsError {
    fn help(&self) -> Option<String> {
        Some(
            "replay again, and let no other program write into the result folder meanwhile"
                .to_owned(),
        )
    }
}

/// Iterates over the values of a JSON lines file. It continues after a line that cannot be parsed.
/// It ends after a line that is too long, since a sparse file is one endless line, and after a read
/// error.
#[derive(Debug)]
pub struct JsonLines<T> {
    path: PathBuf,
    /// `None` after a read error or a line that is too long.
    reader: Option<BufReader<PlainFile>>,
    text: Vec<u8>,
    line: usize,
    value: PhantomData<T>,
}

/// The decisions of a replay, in the order of its wakes.
pub type Decisions = JsonLines<Decision>;

impl Decisions {
    /// Opens `out/decisions.jsonl`.
    ///
    /// # Errors
    ///
    /// [`ResultsError::Read`] if the file cannot be opened.
    pub fn open(out: &Path) -> Result<Decisions, ResultsError> {
        JsonLines::read(out.join("decisions.jsonl"))
    }
}

/// Reads the clips of `out/clips.jsonl`, in the order of their completion.
///
/// # Errors
///
/// [`ResultsError`] if the file cannot be read.
pub fn clips(out: &Path) -> Result<Vec<Clip>, ResultsError> {
    JsonLines::read(out.join("clips.jsonl"))?.collect()
}

impl<T> JsonLines<T> {
    /// Opens the file `path`, whose lines are JSON values.
    ///
    /// # Errors
    ///
    /// [`ResultsError::Read`] if the file cannot be opened.
    pub fn read(path: PathBuf) -> Result<Self, ResultsError> {
        match PlainFile::result(&path, LINES_MAX) {
            Ok(file) => Ok(Self {
                path,
                reader: Some(BufReader::new(file)),
                text: Vec::new(),
                line: 0,
                value: PhantomData,
            }),
            Err(source) => Err(ResultsError::Read { path, source }),
        }
    }

    fn next_line(&mut self) -> Option<Result<(), ResultsError>> {
        let reader = self.reader.as_mut()?;
        self.line += 1;
        self.text.clear();
        match reader.by_ref().take(LINE_MAX.bytes() + 1).read_until(b'\n', &mut self.text) {
            Ok(0) => None,
            Ok(_) if self.text.len() as u64 > LINE_MAX.bytes() => {
                self.reader = None;
                Some(Err(ResultsError::Long { path: self.path.clone(), line: self.line }))
            }
            Ok(_) => Some(Ok(())),
            Err(source) => {
                self.reader = None;
                Some(Err(ResultsError::Read { path: self.path.clone(), source }))
            }
        }
    }
}

impl<T: DeserializeOwned> JsonLines<T> {
    /// Returns the values with the sizes of their lines, in bytes.
    pub(crate) fn with_sizes(mut self) -> impl Iterator<Item = Result<(T, usize), ResultsError>> {
        std::iter::from_fn(move || Some(self.next()?.map(|value| (value, self.text.len()))))
    }
}

impl<T: DeserializeOwned> Iterator for JsonLines<T> {
    type Item = Result<T, ResultsError>;

    fn next(&mut self) -> Option<Self::Item> {
        let read = self.next_line()?;
        Some(read.and_then(|()| {
            serde_json::from_slice(&self.text).map_err(|source| ResultsError::Line {
                path: self.path.clone(),
                line: self.line,
                source,
            })
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reading_continues_after_a_bad_line_but_not_after_one_that_is_too_long() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("decisions.jsonl");
        let long = "1".repeat(LINE_MAX.bytes() as usize + 1);
        std::fs::write(&path, format!("1\nx\n3\n{long}\n5")).unwrap();
        let lines: Vec<_> = JsonLines::<u8>::read(path).unwrap().collect();
        assert_eq!(lines.len(), 4);
        assert!(matches!(lines[0], Ok(1)));
        assert!(matches!(lines[1], Err(ResultsError::Line { line: 2, .. })));
        assert!(matches!(lines[2], Ok(3)));
        assert!(matches!(lines[3], Err(ResultsError::Long { line: 4, .. })));
    }

    #[test]
    fn a_sparse_file_is_refused_or_ends_with_its_first_line() {
        let folder = tempfile::tempdir().unwrap();
        let sparse = |bytes| {
            let file = std::fs::File::create(folder.path().join("decisions.jsonl")).unwrap();
            file.set_len(bytes).unwrap();
            Decisions::open(folder.path())
        };
        let text = gleaner_base::Failure::from(sparse(1 << 40).unwrap_err()).to_string();
        assert!(
            text.contains(
                "decisions.jsonl`\n  cause: it has 1099511627776 bytes; at most 32 GiB are read"
            ),
            "{text}"
        );
        let lines: Vec<_> = sparse(LINES_MAX.bytes()).unwrap().collect();
        assert!(matches!(lines[..], [Err(ResultsError::Long { line: 1, .. })]));
    }

    #[test]
    fn a_pipe_or_a_link_in_place_of_results_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [decisions, clips_list] =
            ["decisions.jsonl", "clips.jsonl"].map(|name| folder.path().join(name));
        assert!(std::process::Command::new("mkfifo").arg(&decisions).status().unwrap().success());
        std::fs::write(folder.path().join("other"), "").unwrap();
        std::os::unix::fs::symlink("other", &clips_list).unwrap();
        let errors = [Decisions::open(folder.path()).err(), clips(folder.path()).err()];
        for (error, message) in errors.into_iter().zip([
            "decisions.jsonl`\n  cause: it is not a regular file",
            "clips.jsonl`\n  cause: it is a link",
        ]) {
            let text = gleaner_base::Failure::from(error.unwrap()).to_string();
            assert!(text.contains(message), "{text}");
        }
    }
}
