use std::io::{self, Read, Write};
use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use gleaner_base::{Exit, safe_file, write_atomically};

/// How long a runtime may take for its end once it was asked for it; then `gleaner-shim` kills it.
/// Who started both waits longer.
pub const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(30);

/// How a runtime ended, as `gleaner-shim` wrote it down: for whoever supervises runtimes, even if
/// it was not there at that time.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExitRecord {
    /// Process id that it had.
    pub pid: u32,
    /// When it was started, in ns of CLOCK_REALTIME.
    pub started_ns: i64,
    /// When it ended, likewise.
    pub ended_ns: i64,
    /// Its exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// The signal that ended it.
    pub signal: Option<i32>,
    /// Why `gleaner-shim` killed it, if it did.
    pub killed: Option<Killed>,
    /// There was no memory left for it: the kernel killed some of it, for its control group had
    /// none; or, ended by SIGABRT, it was refused more by its own limit.
    pub out_of_memory: bool,
    /// The most memory that it had resident, in bytes.
    pub max_rss_bytes: u64,
    /// CPU time that it and what it started used, in ns.
    pub cpu_ns: u64,
    /// Processes that it left behind, which were killed.
    pub orphans: u32,
    /// `gleaner-shim` had been asked to end it. A lambda can ask its own process only, and not the
    /// shim.
    #[serde(default)]
    pub end_requested: bool,
    /// What it was doing when it ended, if it reported that.
    #[serde(default)]
    pub phase: Option<Phase>,
}

/// What a runtime was doing when `gleaner-shim` killed it, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Killed {
    /// What it did.
    pub phase: Phase,
    /// How long it had been at it, or had been stopped, in ns.
    pub ran_ns: u64,
    /// How long that may take before it is killed, in ns.
    pub allowed_ns: u64,
    /// Time of the wake, in ns of the lambda's clock; 0 if there was none.
    pub at_ns: i64,
    /// The limit that it exceeded.
    #[serde(default)]
    pub reason: KillReason,
}

/// The limit of a process that was killed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KillReason {
    /// It did not come back in time.
    #[default]
    Overdue,
    /// A signal had stopped it.
    Stopped,
    /// It kept more memory than it may, in bytes.
    Memory {
        /// Memory that it had.
        used: u64,
        /// Memory that it may have.
        allowed: u64,
    },
    /// It had more threads than it may.
    Threads {
        /// Threads that it had.
        used: u64,
        /// Threads that it may have.
        allowed: u64,
    },
}

/// What a runtime is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum Phase {
    /// It looks after itself between two wakes.
    Housekeeping = 0,
    /// The lambda's `init` runs.
    Init = 1,
    /// The lambda is awake.
    Wake = 2,
}

impl Phase {
    /// From its number; what is unknown counts as `Rounds`.
    pub fn from_number(number: u32) -> Self {
        match number {
            1 => Self::Init,
            2 => Self::Wake,
            _ => Self::Housekeeping,
        }
    }
}

impl Killed {
    /// A sentence for people, without what was killed.
    pub fn sentence(&self) -> String {
        let (ran, allowed) = (self.ran_ns as f64 / 1e9, self.allowed_ns as f64 / 1e9);
        let what = match (self.reason, self.phase) {
            (KillReason::Overdue, Phase::Housekeeping) => "gave no sign of life",
            (KillReason::Overdue, Phase::Init) => "was in its init",
            (KillReason::Overdue, Phase::Wake) => "was in one wake",
            (KillReason::Stopped, _) => "was stopped by a signal",
            (KillReason::Memory { used, allowed }, _) => {
                let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
                let (used, allowed) = (mib(used), mib(allowed));
                return format!(
                    "needed more memory than it may have: {used:.1} MiB, of {allowed:.1} MiB"
                );
            }
            (KillReason::Threads { used, allowed }, _) => {
                return format!("had {used} threads, and may have {allowed}");
            }
        };
        format!("{what} for {ran:.2} s; after {allowed:.2} s it is killed")
    }

    /// The way out.
    pub fn help(&self) -> &'static str {
        match (self.reason, self.phase) {
            (KillReason::Overdue, Phase::Wake) => {
                "do less in one wake, or raise `deadline` in [limits]: a process is killed after twice that and 0.35 s; \
                 in a replay, after 100 times that, or a minute if that is longer"
            }
            (KillReason::Overdue, Phase::Init) => {
                "do less in `init`, or raise `init_deadline` in [limits]: a process is killed after twice that and \
                 0.35 s; in a replay, after 10 times that, or a minute if that is longer"
            }
            (KillReason::Overdue, Phase::Housekeeping) => {
                "no wake ran, so no deadline is too short: look for threads or native code of the lambda that keep its \
                 process busy, and for a disk that does not answer"
            }
            (KillReason::Stopped, _) => {
                "a lambda must not stop its own process, as SIGSTOP does; if it was stopped by hand, go on"
            }
            (KillReason::Memory { .. }, _) => {
                "keep less, or raise `memory` in [limits]; what native code has taken and not freed stays taken when \
                 the lambda is made again"
            }
            (KillReason::Threads { .. }, _) => "start fewer threads, and join those that are done",
        }
    }

    /// What was used and what is allowed, in the unit of the limit: bytes, threads, or ns.
    pub fn used_and_allowed(&self) -> (u64, u64) {
        match self.reason {
            KillReason::Overdue | KillReason::Stopped => (self.ran_ns, self.allowed_ns),
            KillReason::Memory { used, allowed } | KillReason::Threads { used, allowed } => {
                (used, allowed)
            }
        }
    }
}

/// The signal by which a process ends itself, on all of Linux.
const SIGABRT: i32 = 6;

/// Longest record that is read. One has some 300 bytes.
const RECORD_MAX: u64 = 16 << 10;

impl ExitRecord {
    /// Its name in the folder of a run's results.
    pub const FILE: &'static str = "exit.json";

    /// Returns whether the lambda caused the end. Without a request, an end within a call into the
    /// lambda counts as caused by it, and so does an exit code of success: our own failures come
    /// between two calls and have their own exit codes.
    pub fn is_caused_by_lambda(&self) -> bool {
        let is_ours = |code| {
            Exit::from_code(code)
                .is_some_and(|exit| !matches!(exit, Exit::Ok | Exit::LambdaFaulted))
        };
        let is_within = matches!(self.phase, Some(Phase::Init | Phase::Wake));
        self.killed.is_some()
            || self.out_of_memory
            || !self.end_requested && (is_within || !self.code.is_some_and(is_ours))
    }

    /// Whether it ended by itself with an exit code of a run that was completed.
    pub fn is_in_order(&self) -> bool {
        let exit = self.code.and_then(Exit::from_code);
        self.killed.is_none() && matches!(exit, Some(Exit::Ok | Exit::LambdaFaulted))
    }

    /// Why it did not end well, as the end of a sentence about the process; `None` if it did.
    pub fn sentence(&self) -> Option<String> {
        match (self.killed, self.out_of_memory, self.signal, self.code) {
            (Some(killed), ..) => Some(killed.sentence()),
            (None, true, Some(SIGABRT), _) => Some(
                "ended itself: it needed more memory than `memory` in [limits] leaves it"
                    .to_owned(),
            ),
            (None, true, ..) => {
                Some("was killed by the kernel: its control group had no memory left".to_owned())
            }
            (None, false, Some(signal), _) => Some(format!("was ended by signal {signal}")),
            (None, false, None, Some(0)) => None,
            (None, false, None, code) => {
                Some(format!("ended by itself, with exit code {}", code.unwrap_or(-1)))
            }
        }
    }

    /// Writes it so that `path` holds the former record or this one, whole.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        let mut text = serde_json::to_vec_pretty(self).expect("a record is plain data");
        text.push(b'\n');
        write_atomically(path, &text)
    }

    /// Prints it as the last line of standard output, where its process may have left a part of a
    /// line.
    ///
    /// # Errors
    ///
    /// Those of writing.
    pub fn print(&self) -> io::Result<()> {
        let text = serde_json::to_string(self).expect("a record is plain data");
        writeln!(io::stdout(), "\n{text}")
    }

    /// Reads the record at `path`.
    ///
    /// # Errors
    ///
    /// Those of the file system; [`io::ErrorKind::InvalidData`] if it is no record.
    pub fn read(path: &Path) -> io::Result<Self> {
        let mut text = Vec::new();
        safe_file::read(path)?.take(RECORD_MAX).read_to_end(&mut text)?;
        serde_json::from_slice(&text)
            .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::test_folder::TestFolder;

    fn record() -> ExitRecord {
        ExitRecord {
            pid: 17,
            started_ns: 1,
            ended_ns: 2,
            code: None,
            signal: Some(9),
            killed: Some(Killed {
                phase: Phase::Wake,
                ran_ns: 350_000_000,
                allowed_ns: 350_000_000,
                at_ns: 5,
                reason: KillReason::Overdue,
            }),
            out_of_memory: false,
            max_rss_bytes: 1 << 20,
            cpu_ns: 3,
            orphans: 0,
            end_requested: false,
            phase: None,
        }
    }

    #[test]
    fn a_record_of_an_earlier_version_is_read_as_one_of_a_late_process_that_was_not_asked() {
        let mut json = serde_json::to_value(record()).unwrap();
        json.as_object_mut().unwrap().remove("end_requested");
        json["killed"].as_object_mut().unwrap().remove("reason");
        assert_eq!(serde_json::from_value::<ExitRecord>(json).unwrap(), record());
    }

    #[test]
    fn a_process_that_ends_unasked_as_if_asked_was_ended_by_its_lambda() {
        let ended = ExitRecord { killed: None, signal: None, code: Some(0), ..record() };
        assert!(ended.is_caused_by_lambda());
        assert!(
            ExitRecord { code: Some(6), ..ended.clone() }.is_caused_by_lambda(),
            "it had faulted before"
        );
        assert!(!ExitRecord { end_requested: true, ..ended.clone() }.is_caused_by_lambda());
        assert!(
            !ExitRecord { code: Some(5), ..ended.clone() }.is_caused_by_lambda(),
            "our programs have said why"
        );
        assert!(
            ExitRecord { end_requested: true, killed: record().killed, ..ended }
                .is_caused_by_lambda()
        );
    }

    #[test]
    fn help_fits_the_limit_that_was_exceeded() {
        let killed = |reason, phase| Killed { reason, phase, ..record().killed.unwrap() };
        let memory = killed(KillReason::Memory { used: 96 << 20, allowed: 64 << 20 }, Phase::Wake);
        assert_eq!(memory.sentence(), "needed more memory than it may have: 96.0 MiB, of 64.0 MiB");
        assert_eq!(memory.used_and_allowed(), (96 << 20, 64 << 20));
        for (reason, phase, word) in [
            (KillReason::Overdue, Phase::Wake, "raise `deadline`"),
            (KillReason::Overdue, Phase::Init, "raise `init_deadline`"),
            (KillReason::Overdue, Phase::Housekeeping, "no wake ran"),
            (KillReason::Stopped, Phase::Wake, "SIGSTOP"),
            (memory.reason, Phase::Wake, "raise `memory`"),
            (KillReason::Threads { used: 600, allowed: 512 }, Phase::Wake, "fewer threads"),
        ] {
            assert!(killed(reason, phase).help().contains(word), "{reason:?} {phase:?}");
        }
    }

    #[test]
    fn what_was_written_is_read_again_and_replaces_what_was_there() {
        let folder = TestFolder::new();
        let path = folder.path("exit.json");
        record().write(&path).unwrap();
        let second = ExitRecord { killed: None, code: Some(0), signal: None, ..record() };
        second.write(&path).unwrap();
        assert_eq!(ExitRecord::read(&path).unwrap(), second);
        assert_eq!(fs::read_dir(folder.root()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_no_record_is_refused() {
        let folder = TestFolder::new();
        let path = folder.path("exit.json");
        fs::write(&path, "{\"pid\": -1}").unwrap();
        assert_eq!(ExitRecord::read(&path).unwrap_err().kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn a_person_reads_why_it_was_killed() {
        assert_eq!(
            record().sentence().unwrap(),
            "was in one wake for 0.35 s; after 0.35 s it is killed"
        );
        let crashed = ExitRecord { killed: None, signal: Some(11), ..record() };
        assert_eq!(crashed.sentence().unwrap(), "was ended by signal 11");
        let full = |signal| {
            ExitRecord { out_of_memory: true, signal: Some(signal), ..crashed.clone() }
                .sentence()
                .unwrap()
        };
        assert_eq!(
            full(6),
            "ended itself: it needed more memory than `memory` in [limits] leaves it"
        );
        assert_eq!(full(9), "was killed by the kernel: its control group had no memory left");
        assert_eq!(ExitRecord { code: Some(0), signal: None, ..crashed }.sentence(), None);
    }
}
