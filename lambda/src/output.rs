//! The files of a run: `decisions.jsonl`, `log.jsonl`, `summary.json`. Live, `gleaner-shim` writes
//! them; in a replay, the runtime.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::results::LINES_MAX;
use crate::signals::Signals;
use crate::{Decision, LogLine, RESULT_ITEM_MAX};
use gleaner_base::safe_file::{self, UnsafePath};
use gleaner_base::{Exit, Explain, write_atomically};

/// What a run did, as a whole; there once it has ended.
const SUMMARY: &str = "summary.json";

/// What the lambda of a replay read, and what its wakes cost.
const SIGNALS: &str = "signals.json";

/// The page that `gleaner` makes of all of it.
const REPORT: &str = "report.html";

/// Earlier lines of a log that is shared out over two files.
const LOG_BEFORE: &str = "log.before.jsonl";

/// What a replay locks, so that no other writes into the same folder.
pub const LOCK: &str = ".lock";

/// The files of a run beside its clips.
pub const RESULTS: [&str; 8] =
    [LOCK, "clips.jsonl", "decisions.jsonl", "log.jsonl", LOG_BEFORE, REPORT, SIGNALS, SUMMARY];

/// Why results could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write `{}`", path.display())]
pub struct OutputError {
    /// The file.
    pub path: PathBuf,
    /// Why not.
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
            _ => "make room or choose another folder: --out DIR".to_owned(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// Open result files.
pub struct Output {
    folder: PathBuf,
    decisions: Lines,
    log: Lines,
    all: bool,
}

impl Output {
    /// Makes `folder` and starts its files anew. With `all`, decisions without trigger and fault
    /// are written too.
    ///
    /// # Errors
    ///
    /// [`OutputError`] names the file.
    pub fn create(folder: &Path, all: bool) -> Result<Self, OutputError> {
        Self::begin(folder, all, false)
    }

    /// As [`Output::create`]; with `again`, lines are added to the files that are there.
    ///
    /// # Errors
    ///
    /// [`OutputError`] names the file.
    pub fn begin(folder: &Path, all: bool, again: bool) -> Result<Self, OutputError> {
        fs::create_dir_all(folder)
            .map_err(|source| OutputError { path: folder.to_owned(), source })?;
        // A summary says that the files beside it are whole; what was read earlier, and a page
        // about it, would be taken for this run's.
        let replaced = [SUMMARY, SIGNALS, REPORT];
        // A writer that was killed left its part: it takes room, and the next one may not come so
        // far.
        let of_earlier =
            replaced.iter().flat_map(|name| [(*name).to_owned(), format!("{name}.part")]);
        for name in of_earlier.chain((!again).then(|| LOG_BEFORE.to_owned())) {
            let path = folder.join(name);
            match fs::remove_file(&path) {
                Err(source) if source.kind() != io::ErrorKind::NotFound => {
                    return Err(OutputError { path, source });
                }
                _ => {}
            }
        }
        let decisions = Lines::begin(folder.join("decisions.jsonl"), again)?;
        let log = Lines::begin(folder.join("log.jsonl"), again)?;
        Ok(Self { folder: folder.to_owned(), decisions, log, all })
    }

    /// Keeps the log from growing for ever: beyond `bytes` it goes on in a new file, and of the
    /// earlier ones only the last is kept.
    #[must_use]
    pub fn with_log_of(mut self, bytes: u64) -> Self {
        self.log.most = Some((bytes, self.folder.join(LOG_BEFORE)));
        self
    }

    /// Writes a decision, if it is one to keep.
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

    /// Writes what the lambda said.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn log(&mut self, lines: &[LogLine]) -> Result<(), OutputError> {
        lines.iter().try_for_each(|line| self.log.write(line))
    }

    /// Writes what waits, so that a reader sees how far the run is.
    ///
    /// # Errors
    ///
    /// [`OutputError`]
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.decisions.flush()?;
        self.log.flush()
    }

    /// Lines that were taken, and could not be written.
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

    /// Adds what the lambda read.
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

/// A file of lines. It grows by whole lines, so that it can be read whenever this process ends.
/// Only a kill in the middle of a write leaves a part of one, which whoever goes on cuts off.
struct Lines {
    path: PathBuf,
    file: File,
    pending: Vec<u8>,
    /// Lines in `pending`.
    waiting: u64,
    /// Lines that were taken, and could not be written.
    lost: u64,
    /// From how many bytes on it goes on in a new file, and where this one is moved.
    most: Option<(u64, PathBuf)>,
}

/// Bytes that wait for the next write.
const PENDING_BYTES: usize = 64 << 10;

impl Lines {
    fn begin(path: PathBuf, again: bool) -> Result<Self, OutputError> {
        let begun =
            if again { end_in_a_whole_line(&path) } else { safe_file::create(&path).map(drop) };
        let opened = begun.and_then(|()| safe_file::append(&path));
        match opened {
            Ok(file) => {
                Ok(Self { path, file, pending: Vec::new(), waiting: 0, lost: 0, most: None })
            }
            Err(source) => Err(OutputError { path, source }),
        }
    }

    fn write(&mut self, line: &impl Serialize) -> Result<(), OutputError> {
        let failed = |source| OutputError { path: self.path.clone(), source };
        serde_json::to_writer(&mut self.pending, line).map_err(io::Error::from).map_err(failed)?;
        self.pending.push(b'\n');
        self.waiting += 1;
        if self.pending.len() < PENDING_BYTES { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), OutputError> {
        if self.waiting == 0 {
            return Ok(());
        }
        let renewed = self.renew();
        let before = self.file.metadata().map(|metadata| metadata.len());
        let is_full = before
            .as_ref()
            .is_ok_and(|before| before + self.pending.len() as u64 > LINES_MAX.bytes());
        let bounded = renewed
            .and_then(|()| if is_full { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(()) });
        let written = bounded.and_then(|()| self.file.write_all(&self.pending));
        let waited = std::mem::take(&mut self.waiting);
        self.pending.clear();
        written.map_err(|source| {
            self.lost += waited;
            // A part of a line would keep all that comes later from being read.
            if let Ok(before) = before {
                let _ = self.file.set_len(before);
            }
            OutputError { path: self.path.clone(), source }
        })
    }

    /// Goes on in a new file if this one is as long as it may be; it is moved.
    fn renew(&mut self) -> io::Result<()> {
        let Some((most, moved)) = &self.most else { return Ok(()) };
        if self.file.metadata().is_ok_and(|metadata| metadata.len() >= *most) {
            match fs::rename(&self.path, moved) {
                // It was moved before, and no other could be opened.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                renamed => renamed?,
            }
            self.file = safe_file::append(&self.path)?;
        }
        Ok(())
    }
}

/// Cuts off the part of a line that a process left when it was killed while it wrote.
fn end_in_a_whole_line(path: &Path) -> io::Result<()> {
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
        // No line of ours is as long as this. What follows is readable at least.
        None => file.write_all_at(b"\n", len),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LogLevel;
    use crate::test_folder::TestFolder;

    fn said(folder: &Path, name: &str) -> Vec<i64> {
        let text = fs::read_to_string(folder.join(name)).unwrap_or_default();
        text.lines()
            .map(|line| {
                serde_json::from_str::<serde_json::Value>(line).unwrap()["at_ns"].as_i64().unwrap()
            })
            .collect()
    }

    #[test]
    fn what_is_no_file_of_ours_is_refused_in_words_and_left_as_it_is() {
        use std::os::unix::fs::symlink;
        type Put = (fn(&Path, &Path), &'static str);
        let put: [Put; 3] = [
            (|precious, path| symlink(precious, path).unwrap(), "it is a link"),
            (|precious, path| fs::hard_link(precious, path).unwrap(), "the file has other names"),
            (
                |_, path| {
                    assert!(
                        std::process::Command::new("mkfifo").arg(path).status().unwrap().success()
                    )
                },
                "it is no file",
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
            // What begins anew takes its place.
            Output::begin(folder.root(), true, false).unwrap();
            assert!(said(folder.root(), name).is_empty());
            assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        }
    }

    #[test]
    fn a_folder_that_is_missing_is_named_and_a_full_disk_wants_room() {
        let help = |path: &str, kind: io::ErrorKind| {
            OutputError { path: path.into(), source: kind.into() }.help()
        };
        let missing = help("o/wakes.journal", io::ErrorKind::NotFound).unwrap();
        assert_eq!(missing, "there is no folder `o`: create it first, or name a file in another");
        let full = help("o/wakes.journal", io::ErrorKind::StorageFull).unwrap();
        assert!(full.contains("make room"), "{full}");
    }

    #[test]
    fn what_no_program_would_read_is_not_written_and_counted() {
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
    fn a_log_that_was_replaced_by_a_link_goes_on_in_a_file_of_its_own() {
        let folder = TestFolder::new();
        let mut output = Output::create(folder.root(), true).unwrap().with_log_of(100);
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
        assert_eq!(said(folder.root(), "log.jsonl"), [1]);
    }

    #[test]
    fn a_long_log_keeps_its_newest_lines_and_those_of_the_file_before() {
        let folder = TestFolder::new();
        let mut output = Output::create(folder.root(), true).unwrap().with_log_of(1000);
        let line = |at_ns| LogLine { at_ns, level: LogLevel::Info, message: "x".repeat(100) };
        for at_ns in 0..100 {
            output.log(&[line(at_ns)]).unwrap();
            output.flush().unwrap();
        }
        let lines = [said(folder.root(), LOG_BEFORE), said(folder.root(), "log.jsonl")];
        assert!(lines.iter().all(|lines| !lines.is_empty()), "{lines:?}");
        let lines = lines.concat();
        assert!(lines.len() >= 8 && lines.len() < 20, "{lines:?}");
        assert!(lines.iter().rev().copied().eq((0..100).rev().take(lines.len())), "{lines:?}");
        // Those of an earlier run are not taken for this one's.
        drop(Output::create(folder.root(), true).unwrap());
        assert!(!folder.path(LOG_BEFORE).exists());
    }
    #[test]
    fn a_part_of_a_line_that_a_killed_process_left_is_cut_off_and_whole_lines_stay() {
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
