//! What a replay left in its folder, read back and put into the form that people and `expected.txt` share.
//!
//! Nothing is written here, and no file is held in memory as a whole: `decisions.jsonl` may have a line per wake.

use std::io::{self, BufRead, BufReader, Read};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

pub use gleaner_base::grouped;
use gleaner_base::{Exit, Explain, PlainFile, visible};
use gleaner_lambda::results::{LINE_MAX, LINES_MAX};
use gleaner_lambda::{Clip, Decision, Trigger};
use serde::de::DeserializeOwned;

/// Why results cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// A file cannot be read.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A line is no decision, or no clip.
    #[error("`{}`, line {line}, is not what a replay writes", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// Why not.
        source: serde_json::Error,
    },
    /// A line is longer than any that Gleaner writes.
    #[error("`{}`, line {line}, is longer than {LINE_MAX}", path.display())]
    Long {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
}

impl Explain for ResultsError {
    fn help(&self) -> Option<String> {
        Some("replay again; nothing else may write into the folder of the results meanwhile".to_owned())
    }

    fn exit(&self) -> Exit {
        Exit::Internal
    }
}

/// A file of JSON lines, read one by one. After a line that cannot be used the next one follows; after one that is too long none, since a
/// sparse file is one line without an end; and after a file that cannot be read, none.
#[derive(Debug)]
pub struct JsonLines<T> {
    path: PathBuf,
    /// `None` once it could not be read.
    reader: Option<BufReader<PlainFile>>,
    text: Vec<u8>,
    line: usize,
    of: PhantomData<T>,
}

/// The decisions of a replay, in the order of its wakes.
pub type Decisions = JsonLines<Decision>;

impl Decisions {
    /// The decisions in `out/decisions.jsonl`.
    ///
    /// # Errors
    ///
    /// [`ResultsError::Read`] if the file cannot be opened.
    pub fn open(out: &Path) -> Result<Decisions, ResultsError> {
        JsonLines::read(out.join("decisions.jsonl"))
    }
}

/// The clips in `out/clips.jsonl`, in the order in which they were finished.
///
/// # Errors
///
/// [`ResultsError`] if the file cannot be read.
pub fn clips(out: &Path) -> Result<Vec<Clip>, ResultsError> {
    JsonLines::read(out.join("clips.jsonl"))?.collect()
}

impl<T> JsonLines<T> {
    /// The lines of the file `path`.
    pub(crate) fn read(path: PathBuf) -> Result<Self, ResultsError> {
        match PlainFile::result(&path, LINES_MAX) {
            Ok(file) => {
                Ok(Self { path, reader: Some(BufReader::new(file)), text: Vec::new(), line: 0, of: PhantomData })
            }
            Err(source) => Err(ResultsError::Read { path, source }),
        }
    }

    /// Reads the next line; `None` at the end of the file.
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
    /// The same, each with the bytes of its line.
    pub(crate) fn weighed(mut self) -> impl Iterator<Item = Result<(T, usize), ResultsError>> {
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

/// A line of `expected.txt` for each trigger of `decision`: `<seconds %.3f> <label> <score %.3g>`; no score is `-`.
///
/// `start_ns` is [`Summary::start_ns`](gleaner_protocol::Summary::start_ns): seconds count from the first message of
/// the drive, of whatever topic.
pub fn trigger_lines(decision: &Decision, start_ns: i64) -> impl Iterator<Item = String> {
    let seconds = seconds(decision.at_ns, start_ns);
    decision.triggers.iter().map(move |trigger| format!("{seconds:.3} {} {}", visible(&trigger.label), score(trigger)))
}

/// The score of `trigger` in three significant digits, `-` if it has none.
pub fn score(trigger: &Trigger) -> String {
    trigger.score.map_or("-".to_owned(), three_digits)
}

/// `bytes` as people read it: `205 KiB`, `1.3 MiB`.
pub fn size(bytes: u64) -> String {
    match bytes {
        0..1024 => format!("{bytes} B"),
        1024..1_048_576 => format!("{} KiB", bytes.div_ceil(1024)),
        _ => format!("{:.1} MiB", bytes as f64 / (1024.0 * 1024.0)),
    }
}

/// What is in a clip: `9.1 s, 205 KiB: messages /imu/data 950, /vehicle/speed 757`.
pub fn clip_contents(clip: &Clip) -> String {
    let [from, to] = clip_span(clip);
    let topics = clip.topics.iter().map(|topic| format!("{} {}", visible(&topic.topic), grouped(topic.messages)));
    format!("{:.1} s, {}: messages {}", seconds(to, from), size(clip.bytes), topics.collect::<Vec<_>>().join(", "))
}

/// Log times of a clip's first and last message; of what was asked for, if it has none.
pub fn clip_span(clip: &Clip) -> [i64; 2] {
    [clip.first_ns.unwrap_or(clip.from_ns), clip.last_ns.unwrap_or(clip.to_ns)]
}

/// Log time `at_ns` in s after `start_ns`.
pub fn seconds(at_ns: i64, start_ns: i64) -> f64 {
    at_ns.saturating_sub(start_ns) as f64 / 1e9
}

/// `value` as C's `printf("%.3g")` writes it: three significant digits, without zeros at the end, in scientific
/// notation from 1000 on and below 0.0001.
///
/// Source: ISO C, `fprintf`, conversion `g`: with precision P and exponent X it is `%f` if P > X >= -4, else `%e`.
pub fn three_digits(value: f64) -> String {
    if !value.is_finite() {
        return value.to_string().to_lowercase();
    }
    // Rounding may carry into the next power of ten, so the exponent is read from the rounded value.
    let scientific = format!("{value:.2e}");
    let (digits, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trimmed = |text: &str| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text.to_owned(),
    };
    match exponent {
        -4..=2 => trimmed(&format!("{value:.*}", (2 - exponent) as usize)),
        _ => format!("{}e{}{:02}", trimmed(digits), if exponent < 0 { '-' } else { '+' }, exponent.abs()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_are_those_of_printf() {
        // Right column: `printf '%.3g'` of a C library.
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "-0"),
            (1.0, "1"),
            (1.5, "1.5"),
            (1.456, "1.46"),
            (-1.456, "-1.46"),
            (1.125, "1.12"),
            (1.375, "1.38"),
            (0.1, "0.1"),
            (9.996, "10"),
            (99.96, "100"),
            (999.4, "999"),
            (999.6, "1e+03"),
            (1234.0, "1.23e+03"),
            (0.000123456, "0.000123"),
            (0.00009999, "0.0001"),
            (0.0000999, "9.99e-05"),
            (0.00001, "1e-05"),
            (1e100, "1e+100"),
            (5e-324, "4.94e-324"),
            (f64::NAN, "nan"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
        ] {
            assert_eq!(three_digits(value), text, "of {value:?}");
        }
    }

    #[test]
    fn a_size_has_the_unit_that_suits_it() {
        let sizes = [0, 1023, 1024, 1025, 205_089, 1_048_576, 10_000_000].map(size);
        assert_eq!(sizes, ["0 B", "1023 B", "1 KiB", "2 KiB", "201 KiB", "1.0 MiB", "9.5 MiB"]);
    }

    #[test]
    fn thousands_are_grouped() {
        for (count, text) in [(0, "0"), (999, "999"), (1000, "1,000"), (123_456, "123,456"), (1_234_567, "1,234,567")] {
            assert_eq!(grouped(count), text);
        }
    }

    #[test]
    fn a_trigger_is_a_line_with_its_time_after_the_start() {
        let decision: Decision = serde_json::from_str(concat!(
            r#"{"at_ns":1700000010810000000,"cause":"event","input":"imu","topic":"/imu","writer":null,"seq":1,"#,
            r#""triggers":[{"kind":"event","label":"hard-brake","score":1.456,"attributes":{}},"#,
            r#"{"kind":"stop","label":"a\u001b[2J","score":null,"attributes":{}}],"fault":null,"fuel":1,"run_ns":2}"#
        ))
        .unwrap();
        let lines: Vec<_> = trigger_lines(&decision, 1_700_000_000_000_000_000).collect();
        assert_eq!(lines, ["10.810 hard-brake 1.46", "10.810 a\\u{1b}[2J -"]);
    }

    #[test]
    fn a_line_that_cannot_be_used_is_named_and_the_next_one_follows_unless_it_is_too_long() {
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
    fn a_file_without_an_end_is_refused_or_ends_with_its_first_line_without_one() {
        let folder = tempfile::tempdir().unwrap();
        let sparse = |bytes| {
            let file = std::fs::File::create(folder.path().join("decisions.jsonl")).unwrap();
            file.set_len(bytes).unwrap();
            Decisions::open(folder.path())
        };
        let text = gleaner_base::Failure::from(sparse(1 << 40).unwrap_err()).to_string();
        assert!(
            text.contains("decisions.jsonl`\n  cause: it has 1099511627776 bytes; at most 32 GiB are read"),
            "{text}"
        );
        let lines: Vec<_> = sparse(LINES_MAX.bytes()).unwrap().collect();
        assert!(matches!(lines[..], [Err(ResultsError::Long { line: 1, .. })]));
    }

    #[test]
    fn a_pipe_or_a_link_in_the_place_of_results_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [decisions, clips_list] = ["decisions.jsonl", "clips.jsonl"].map(|name| folder.path().join(name));
        assert!(std::process::Command::new("mkfifo").arg(&decisions).status().unwrap().success());
        std::fs::write(folder.path().join("other"), "").unwrap();
        std::os::unix::fs::symlink("other", &clips_list).unwrap();
        let errors = [Decisions::open(folder.path()).err(), clips(folder.path()).err()];
        for (error, said) in
            errors.into_iter().zip(["decisions.jsonl`\n  cause: it is no file", "clips.jsonl`\n  cause: it is a link"])
        {
            let text = gleaner_base::Failure::from(error.unwrap()).to_string();
            assert!(text.contains(said), "{text}");
        }
    }

    #[test]
    fn times_at_the_ends_of_the_range_do_not_overflow() {
        assert!(seconds(i64::MIN, i64::MAX) < 0.0);
        assert_eq!(seconds(1_500_000_000, 0), 1.5);
    }
}
