//! Writes the result files of a run: `decisions.jsonl`, `log.jsonl`, `summary.json`. `gleaner-shim`
//! writes those of a live run, the runtime those of a replay.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::output_lock::LOCK;
use crate::results::LINES_MAX;
use crate::signals::Signals;
use crate::{Decision, LogLine, RESULT_ITEM_MAX};
use gleaner_base::safe_file::{self, UnsafePath};
use gleaner_base::{Exit, Explain, write_atomically};

/// The summary of a run, written at its end.
const SUMMARY: &str = "summary.json";

/// The values that the lambda of a replay read, and the cost of its wakes.
const SIGNALS: &str = "signals.json";

/// The report that `gleaner` makes of the results.
const REPORT: &str = "report.html";

/// Earlier lines of a rotated log.
const PREVIOUS_LOG: &str = "log.before.jsonl";

/// The files of a run beside its clips.
pub const RESULTS: [&str; 8] =
    [LOCK, "clips.jsonl", "decisions.jsonl", "log.jsonl", PREVIOUS_LOG, REPORT, SIGNALS, SUMMARY];

#[derive(Debug, thiserror::Error)]
#[error("cannot write `{}`", path.display())]
pub struct OutputError {
    pub path: PathBuf,
    pub source: io::Error,
}

impl Explain for OutputError {
    fn help(&self) -> Option<String> {
        let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty());
        Some(match (UnsafePath::of(&self.source), folder) {
            (Some(_), _) => UnsafePath::HELP.to_owned(),
            // A folder of results is created; that of a journal is not.
            (None, Some(folder)) if self.source.kind() == io::ErrorKind::NotFound => {
                format!(
                    "there is no folder `{}`: create it first, or name a file in another",
                    folder.display()
                )
            }
            _ => "make room on the disk, or choose another folder: --out DIR".to_owned(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// Open result files.
pub struct Output {
    folder: PathBuf,
    decisions: LineWriter,
    log: LineWriter,
    /// True if decisions without trigger and fault are written, too.
    all: bool,
}

impl Output {
    /// Creates `folder` and truncates its files. With `all`, decisions without trigger and fault
    /// are written, too.
    ///
    /// # Errors
    ///
    /// [`OutputError`] names the file.
    pub fn create(folder: &Path, all: bool) -> Result<Self, OutputError> {
        Self::begin(folder, all, false)
    }

    /// Creates the files as [`Output::create`] does; with `append`, lines are appended to existing
    /// files.
    ///
    /// # Errors
    ///
    /// [`OutputError`] names the file.
    pub fn begin(folder: &Path, all: bool, append: bool) -> Result<Self, OutputError> {
        fs::create_dir_all(folder)
            .map_err(|source| OutputError { path: folder.to_owned(), source })?;
        // A summary means that the files beside it are complete; earlier signals and an earlier
        // report would be taken for those of this run.
        let replaced = [SUMMARY, SIGNALS, REPORT];
        // A killed writer leaves its temporary file, which takes disk space; this run may never
        // replace it.
        let of_earlier =
            replaced.iter().flat_map(|name| [(*name).to_owned(), format!("{name}.part")]);
        for name in of_earlier.chain((!append).then(|| PREVIOUS_LOG.to_owned())) {
            let path = folder.join(name);
            match fs::remove_file(&path) {
                Err(source) if source.kind() != io::ErrorKind::NotFound => {
                    return Err(OutputError { path, source });
                }
                _ => {}
            }
        }
        let decisions = LineWriter::open(folder.join("decisions.jsonl"), append)?;
        let log = LineWriter::open(folder.join("log.jsonl"), append)?;
        Ok(Self { folder: folder.to_owned(), decisions, log, all })
    }

    /// Rotates the log when it exceeds `bytes`; of the earlier files only the last is kept.
    #[must_use]
    pub fn with_log_rotation(mut self, bytes: u64) -> Self {
        self.log.rotation = Some((bytes, self.folder.join(PREVIOUS_LOG)));
        self
    }

    /// Writes a decision, unless it has neither trigger nor fault and `all` is off.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn decision(&mut self, decision: &Decision) -> Result<(), OutputError> {
        if self.all || !decision.triggers.is_empty() || decision.fault.is_some() {
            self.decisions.write(decision)?;
        }
        Ok(())
    }

    /// Writes log lines of the lambda.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn log(&mut self, lines: &[LogLine]) -> Result<(), OutputError> {
        lines.iter().try_for_each(|line| self.log.write(line))
    }

    /// Writes pending lines, so that a reader sees the progress of the run.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.decisions.flush()?;
        self.log.flush()
    }

    /// Returns the number of accepted lines that could not be written.
    pub fn lost(&self) -> u64 {
        self.decisions.lost + self.log.lost
    }

    /// Completes the files and adds the summary.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn finish(mut self, summary: &impl Serialize) -> Result<(), OutputError> {
        self.flush()?;
        let path = self.folder.join(SUMMARY);
        let mut text = serde_json::to_vec_pretty(summary).expect("a summary is plain data");
        text.push(b'\n');
        write_atomically(&path, &text).map_err(|source| OutputError { path, source })
    }

    /// Writes `signals.json`.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn signals(&self, signals: &Signals) -> Result<(), OutputError> {
        let path = self.folder.join(SIGNALS);
        let text = serde_json::to_vec(signals).expect("signals are plain data, and finite");
        write_atomically(&path, &text).map_err(|source| OutputError { path, source })
    }
}

/// Appends JSON lines to a file. It writes whole lines, so that the file can be read whenever this
/// process ends. Only a kill in the middle of a write leaves a partial line, which the next writer
/// cuts off.
struct LineWriter {
    path: PathBuf,
    file: File,
    pending: Vec<u8>,
    pending_lines: u64,
    /// Accepted lines that could not be written.
    lost: u64,
    /// The length at which the file is rotated, and the path that it is moved to.
    rotation: Option<(u64, PathBuf)>,
}

/// Length of pending lines at which they are written.
const PENDING_BYTES: usize = 64 << 10;

impl LineWriter {
    fn open(path: PathBuf, append: bool) -> Result<Self, OutputError> {
        let begun =
            if append { cut_partial_line(&path) } else { safe_file::create(&path).map(drop) };
        let file = match begun.and_then(|()| safe_file::append(&path)) {
            Ok(file) => file,
            Err(source) => return Err(OutputError { path, source }),
        };
        Ok(Self { path, file, pending: Vec::new(), pending_lines: 0, lost: 0, rotation: None })
    }

    fn write(&mut self, line: &impl Serialize) -> Result<(), OutputError> {
        let failed = |source| OutputError { path: self.path.clone(), source };
        serde_json::to_writer(&mut self.pending, line).map_err(io::Error::from).map_err(failed)?;
        self.pending.push(b'\n');
        self.pending_lines += 1;
        if self.pending.len() < PENDING_BYTES { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), OutputError> {
        if self.pending_lines == 0 {
            return Ok(());
        }
        let rotated = self.rotate();
        let before = self.file.metadata().map(|metadata| metadata.len());
        let is_full = before
            .as_ref()
            .is_ok_and(|before| before + self.pending.len() as u64 > LINES_MAX.bytes());
        let bounded = rotated
            .and_then(|()| if is_full { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(()) });
        let written = bounded.and_then(|()| self.file.write_all(&self.pending));
        let count = std::mem::take(&mut self.pending_lines);
        self.pending.clear();
        written.map_err(|source| {
            self.lost += count;
            // A partial line would make all later lines unreadable.
            if let Ok(before) = before {
                let _ = self.file.set_len(before);
            }
            OutputError { path: self.path.clone(), source }
        })
    }

    /// Moves the file and opens a new one, if it has reached the length of rotation.
    fn rotate(&mut self) -> io::Result<()> {
        let Some((max_bytes, previous)) = &self.rotation else { return Ok(()) };
        if self.file.metadata().is_ok_and(|metadata| metadata.len() >= *max_bytes) {
            match fs::rename(&self.path, previous) {
                // It was moved before, and a new one could not be opened.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                renamed => renamed?,
            }
            self.file = safe_file::append(&self.path)?;
        }
        Ok(())
    }
}

/// Cuts off the partial line that a process left when it was killed during a write.
fn cut_partial_line(path: &Path) -> io::Result<()> {
    let file = safe_file::write(path)?;
    let len = file.metadata()?.len();
    let start = len.saturating_sub(RESULT_ITEM_MAX as u64);
    let mut tail = vec![0; 1];
    if len == 0 || (file.read_exact_at(&mut tail, len - 1).is_ok() && tail == *b"\n") {
        return Ok(());
    }
    tail.resize(usize::try_from(len - start).unwrap_or(RESULT_ITEM_MAX), 0);
    file.read_exact_at(&mut tail, start)?;
    match tail.iter().rposition(|byte| *byte == b'\n') {
        Some(end) => file.set_len(start + end as u64 + 1),
        None if start == 0 => file.set_len(0),
        // No Gleaner program writes such a line. A line break makes at least the next lines
        // readable.
        None => file.write_all_at(b"\n", len),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LogLevel;
    use gleaner_test_support::TestFolder;

    fn times(folder: &Path, name: &str) -> Vec<i64> {
        let text = fs::read_to_string(folder.join(name)).unwrap_or_default();
        text.lines()
            .map(|line| {
                serde_json::from_str::<serde_json::Value>(line).unwrap()["at_ns"].as_i64().unwrap()
            })
            .collect()
    }

    #[test]
    fn a_link_or_pipe_in_place_of_a_result_file_is_refused_and_left_unchanged() {
        use std::os::unix::fs::symlink;
        type Put = (fn(&Path, &Path), &'static str);
        let put: [Put; 3] = [
            (|precious, path| symlink(precious, path).unwrap(), "it is a link"),
            (
                |precious, path| fs::hard_link(precious, path).unwrap(),
                "the file has other hard links",
            ),
            (
                |_, path| {
                    assert!(
                        std::process::Command::new("mkfifo").arg(path).status().unwrap().success()
                    )
                },
                "it is not a regular file",
            ),
        ];
        let cases = ["decisions.jsonl", "log.jsonl"]
            .into_iter()
            .flat_map(|name| put.map(|put| (name, put)));
        for (name, (put, why)) in cases {
            let folder = TestFolder::new();
            let (precious, path) = (folder.path("precious"), folder.path(name));
            fs::write(&precious, "precious").unwrap();
            put(&precious, &path);
            let error = Output::begin(folder.root(), true, true).err().unwrap();
            assert_eq!(error.help().unwrap(), "remove it, or choose another folder: --out DIR");
            let text = gleaner_base::Failure::from(error).to_string();
            assert!(
                text.contains(&format!("`{}`", path.display())) && text.contains(why),
                "{text}"
            );
            // Without `append`, a new file replaces it.
            Output::begin(folder.root(), true, false).unwrap();
            assert!(times(folder.root(), name).is_empty());
            assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        }
    }

    #[test]
    fn help_names_a_missing_folder_or_suggests_to_make_room_on_a_full_disk() {
        let help = |path: &str, kind: io::ErrorKind| {
            OutputError { path: path.into(), source: kind.into() }.help()
        };
        let missing = help("o/wakes.journal", io::ErrorKind::NotFound).unwrap();
        assert_eq!(missing, "there is no folder `o`: create it first, or name a file in another");
        let full = help("o/wakes.journal", io::ErrorKind::StorageFull).unwrap();
        assert!(full.contains("make room"), "{full}");
    }

    #[test]
    fn lines_beyond_the_length_that_readers_accept_are_not_written_but_counted() {
        let folder = TestFolder::new();
        let mut output = Output::create(folder.root(), true).unwrap();
        let log = File::options().write(true).open(folder.path("log.jsonl")).unwrap();
        log.set_len(LINES_MAX.bytes() - 10).unwrap();
        output
            .log(&[LogLine { at_ns: 1, level: LogLevel::Info, message: "x".to_owned() }])
            .unwrap();
        assert_eq!(output.flush().unwrap_err().source.kind(), io::ErrorKind::FileTooLarge);
        assert_eq!((output.lost(), log.metadata().unwrap().len()), (1, LINES_MAX.bytes() - 10));
    }

    #[test]
    fn a_rotated_log_does_not_follow_a_link_at_its_path() {
        let folder = TestFolder::new();
        let mut output = Output::create(folder.root(), true).unwrap().with_log_rotation(100);
        let line = LogLine { at_ns: 1, level: LogLevel::Info, message: "x".repeat(200) };
        output.log(std::slice::from_ref(&line)).unwrap();
        output.flush().unwrap();
        let (precious, log) = (folder.path("precious"), folder.path("log.jsonl"));
        fs::write(&precious, "precious").unwrap();
        fs::remove_file(&log).unwrap();
        std::os::unix::fs::symlink(&precious, &log).unwrap();
        output.log(&[line]).unwrap();
        output.flush().unwrap();
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        assert_eq!(times(folder.root(), "log.jsonl"), [1]);
    }

    #[test]
    fn a_long_log_keeps_its_newest_lines_in_two_files() {
        let folder = TestFolder::new();
        let mut output = Output::create(folder.root(), true).unwrap().with_log_rotation(1000);
        let line = |at_ns| LogLine { at_ns, level: LogLevel::Info, message: "x".repeat(100) };
        for at_ns in 0..100 {
            output.log(&[line(at_ns)]).unwrap();
            output.flush().unwrap();
        }
        let lines = [times(folder.root(), PREVIOUS_LOG), times(folder.root(), "log.jsonl")];
        assert!(lines.iter().all(|lines| !lines.is_empty()), "{lines:?}");
        let lines = lines.concat();
        assert!(lines.len() >= 8 && lines.len() < 20, "{lines:?}");
        assert!(lines.iter().rev().copied().eq((0..100).rev().take(lines.len())), "{lines:?}");
        // Lines of an earlier run are removed.
        drop(Output::create(folder.root(), true).unwrap());
        assert!(!folder.path(PREVIOUS_LOG).exists());
    }

    #[test]
    fn a_partial_line_of_a_killed_process_is_cut_off_and_whole_lines_stay() {
        let long = "x".repeat(RESULT_ITEM_MAX);
        let cases = [
            (String::new(), String::new()),
            ("{\"at_ns\"".to_owned(), String::new()),
            ("1\n22\n".to_owned(), "1\n22\n".to_owned()),
            ("1\n22\n{\"at_ns\": 3".to_owned(), "1\n22\n".to_owned()),
            (format!("1\n{long}"), format!("1\n{long}\n")),
        ];
        for (before, after) in cases {
            let folder = TestFolder::new();
            for name in ["decisions.jsonl", "log.jsonl"] {
                folder.write(name, &before);
            }
            drop(Output::begin(folder.root(), true, true).unwrap());
            for name in ["decisions.jsonl", "log.jsonl"] {
                assert!(
                    fs::read_to_string(folder.path(name)).unwrap() == after,
                    "{name} of {} bytes",
                    before.len()
                );
            }
        }
    }
}
