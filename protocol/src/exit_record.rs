//! The record of a runtime's end: `gleaner-shim` writes it, the supervisor reads it.

use std::io::{self, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::ExitStatus;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use gleaner_base::{Exit, safe_file, write_atomically};

/// Time from the request to end a runtime until `gleaner-shim` kills it. The supervisor waits
/// longer before it kills `gleaner-shim`.
pub const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(30);

/// The end of a runtime. `gleaner-shim` writes it for the supervisor, even if the supervisor has
/// ended before.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExitRecord {
    /// Process id of the runtime.
    pub pid: u32,
    /// Start time, in ns of `CLOCK_REALTIME`.
    pub started_ns: i64,
    /// End time, in ns of `CLOCK_REALTIME`.
    pub ended_ns: i64,
    /// Exit code; `None` if a signal ended the runtime.
    pub code: Option<i32>,
    /// Signal that ended the runtime, if one did.
    pub signal: Option<i32>,
    /// The reason, if `gleaner-shim` killed the runtime because it exceeded a limit.
    pub killed: Option<Killed>,
    /// True if the runtime ran out of memory: the kernel killed a process of its control group, or
    /// it aborted after it was refused memory.
    pub out_of_memory: bool,
    /// Peak resident memory, in bytes; live, samples in shared memory are part of it.
    pub max_rss_bytes: u64,
    /// CPU time of the runtime and its children, in ns.
    pub cpu_ns: u64,
    /// Number of processes that outlived the runtime and were killed.
    pub orphans: u32,
    /// True if `gleaner-shim` received a signal to end the runtime. A lambda cannot forge this: it
    /// can signal its own process only.
    #[serde(default)]
    pub end_requested: bool,
    /// Phase of the runtime at its end, if known.
    #[serde(default)]
    pub phase: Option<Phase>,
}

/// The reason why `gleaner-shim` killed a runtime, and the phase of the runtime.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Killed {
    /// Phase in which the runtime was killed.
    pub phase: Phase,
    /// Time in that phase, or time stopped by a signal, in ns.
    pub ran_ns: u64,
    /// Maximum of that time, in ns.
    pub allowed_ns: u64,
    /// Time of the wake, in ns of the lambda's clock; 0 outside of a wake.
    pub at_ns: i64,
    /// The limit that the runtime exceeded.
    #[serde(default)]
    pub reason: KillReason,
}

/// The limit that a killed runtime had exceeded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KillReason {
    /// A call into the lambda, or the runtime, did not return in time.
    #[default]
    Overdue,
    /// A signal stopped the runtime.
    Stopped,
    /// The runtime used more memory than allowed, in bytes.
    Memory {
        /// Used memory.
        used: u64,
        /// Allowed memory.
        allowed: u64,
    },
    /// The runtime had more threads than allowed.
    Threads {
        /// Number of threads.
        used: u64,
        /// Allowed number of threads.
        allowed: u64,
    },
}

/// The phase of a runtime.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum Phase {
    /// Between two calls into the lambda.
    Housekeeping = 0,
    /// The lambda's `init` runs.
    Init = 1,
    /// The lambda is awake.
    Wake = 2,
}

impl Phase {
    /// Returns the phase with this number; `Housekeeping` for an unknown number.
    pub fn from_number(number: u32) -> Self {
        match number {
            1 => Self::Init,
            2 => Self::Wake,
            _ => Self::Housekeeping,
        }
    }
}

impl Killed {
    /// Returns the reason as a sentence for the user, without its subject, the process.
    pub fn sentence(&self) -> String {
        let (ran, allowed) = (self.ran_ns as f64 / 1e9, self.allowed_ns as f64 / 1e9);
        let what = match (self.reason, self.phase) {
            (KillReason::Overdue, Phase::Housekeeping) => "did not respond",
            (KillReason::Overdue, Phase::Init) => "was in its init",
            (KillReason::Overdue, Phase::Wake) => "was in one wake",
            (KillReason::Stopped, _) => "was stopped by a signal",
            (KillReason::Memory { used, allowed }, _) => {
                let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
                let (used, allowed) = (mib(used), mib(allowed));
                return format!("used {used:.1} MiB of memory; the limit is {allowed:.1} MiB");
            }
            (KillReason::Threads { used, allowed }, _) => {
                return format!("had {used} threads; the limit is {allowed}");
            }
        };
        format!("{what} for {ran:.2} s; the limit is {allowed:.2} s")
    }

    /// Returns what the author of the lambda can do about it.
    pub fn help(&self) -> &'static str {
        match (self.reason, self.phase) {
            (KillReason::Overdue, Phase::Wake) => {
                "do less in one wake, or raise `deadline` in [limits]: a process is killed after \
                 six times the deadline plus 0.35 s; in a replay, after 100 times the deadline, \
                 but at least a minute"
            }
            (KillReason::Overdue, Phase::Init) => {
                "do less in `init`, or raise `init_deadline` in [limits]: a process is killed \
                 after six times the deadline plus 0.35 s; in a replay, after 10 times the \
                 deadline, but at least a minute"
            }
            (KillReason::Overdue, Phase::Housekeeping) => {
                "no wake ran, so no deadline is too short: look for threads or native code of the \
                 lambda that keep its process busy, and for a disk that does not respond"
            }
            (KillReason::Stopped, _) => {
                "a lambda must not stop its own process, for example with SIGSTOP; nothing is \
                 wrong if a user stopped it"
            }
            (KillReason::Memory { .. }, _) => {
                "keep less data, or raise `memory` in [limits]; memory that native code does not \
                 free stays allocated when the lambda is re-initialised"
            }
            (KillReason::Threads { .. }, _) => {
                "start fewer threads, and join those that have ended"
            }
        }
    }

    /// Returns the used and the allowed amount, in the unit of the limit: bytes, threads, or ns.
    pub fn used_and_allowed(&self) -> (u64, u64) {
        match self.reason {
            KillReason::Overdue | KillReason::Stopped => (self.ran_ns, self.allowed_ns),
            KillReason::Memory { used, allowed } | KillReason::Threads { used, allowed } => {
                (used, allowed)
            }
        }
    }
}

/// The signal of `abort`, on all Linux platforms.
const SIGABRT: i32 = 6;

/// Maximum length of a record, in bytes. A usual one has about 300.
const RECORD_MAX: u64 = 16 << 10;

impl ExitRecord {
    /// Name of the record's file in the output folder.
    pub const FILE: &'static str = "exit.json";

    /// Returns whether the lambda caused the end: always if the runtime was killed for a limit or
    /// ran out of memory. Otherwise, an end that was not requested counts as caused by the lambda
    /// unless it came between two calls into the lambda with the exit code of a Gleaner failure.
    pub fn is_caused_by_lambda(&self) -> bool {
        let is_internal = |code| {
            Exit::from_code(code)
                .is_some_and(|exit| !matches!(exit, Exit::Ok | Exit::LambdaFaulted))
        };
        let is_within = matches!(self.phase, Some(Phase::Init | Phase::Wake));
        self.killed.is_some()
            || self.out_of_memory
            || !self.end_requested && (is_within || !self.code.is_some_and(is_internal))
    }

    /// Returns whether the runtime exited by itself with the exit code of a complete run.
    pub fn is_complete(&self) -> bool {
        let exit = self.code.and_then(Exit::from_code);
        self.killed.is_none() && matches!(exit, Some(Exit::Ok | Exit::LambdaFaulted))
    }

    /// Returns the cause of the end as a sentence without its subject, the process; `None` for exit
    /// code 0.
    pub fn sentence(&self) -> Option<String> {
        match (self.killed, self.out_of_memory, self.signal, self.code) {
            (Some(killed), ..) => Some(killed.sentence()),
            (None, true, Some(SIGABRT), _) => Some(
                "ended itself: it needed more memory than `memory` in [limits] allows".to_owned(),
            ),
            (None, true, ..) => {
                Some("was killed by the kernel: its control group had no memory left".to_owned())
            }
            // Of the library: `signal: 9 (SIGKILL)`.
            (None, false, Some(signal), _) => {
                let named = ExitStatus::from_raw(signal).to_string();
                Some(format!("was ended by {}", named.replacen(':', "", 1)))
            }
            (None, false, None, Some(0)) => None,
            (None, false, None, code) => {
                Some(format!("ended by itself, with exit code {}", code.unwrap_or(-1)))
            }
        }
    }

    /// Writes the record to `path`, atomically.
    ///
    /// # Errors
    ///
    /// Errors of the file system.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        let mut text = serde_json::to_vec_pretty(self).expect("a record is plain data");
        text.push(b'\n');
        write_atomically(path, &text)
    }

    /// Prints the record as the last line of standard output, after a line break: the runtime may
    /// have printed a partial line.
    ///
    /// # Errors
    ///
    /// Errors of writing.
    pub fn print(&self) -> io::Result<()> {
        let text = serde_json::to_string(self).expect("a record is plain data");
        writeln!(io::stdout(), "\n{text}")
    }

    /// Reads the record at `path`.
    ///
    /// # Errors
    ///
    /// Errors of the file system; [`io::ErrorKind::InvalidData`] if it is not a record.
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
    use gleaner_test_support::TestFolder;

    fn record() -> ExitRecord {
        ExitRecord {
            pid: 17,
            started_ns: 1,
            ended_ns: 2,
            signal: Some(9),
            killed: Some(Killed {
                phase: Phase::Wake,
                ran_ns: 350_000_000,
                allowed_ns: 350_000_000,
                at_ns: 5,
                reason: KillReason::Overdue,
            }),
            max_rss_bytes: 1 << 20,
            cpu_ns: 3,
            ..ExitRecord::default()
        }
    }

    #[test]
    fn missing_keys_of_a_record_mean_overdue_and_no_request() {
        let mut json = serde_json::to_value(record()).unwrap();
        json.as_object_mut().unwrap().remove("end_requested");
        json["killed"].as_object_mut().unwrap().remove("reason");
        assert_eq!(serde_json::from_value::<ExitRecord>(json).unwrap(), record());
    }

    #[test]
    fn a_process_that_exits_with_success_without_a_request_was_ended_by_its_lambda() {
        let ended = ExitRecord { killed: None, signal: None, code: Some(0), ..record() };
        assert!(ended.is_caused_by_lambda());
        assert!(
            ExitRecord { code: Some(6), ..ended.clone() }.is_caused_by_lambda(),
            "it had faulted before"
        );
        assert!(!ExitRecord { end_requested: true, ..ended.clone() }.is_caused_by_lambda());
        assert!(
            !ExitRecord { code: Some(5), ..ended.clone() }.is_caused_by_lambda(),
            "an error of the runtime"
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
        assert_eq!(memory.sentence(), "used 96.0 MiB of memory; the limit is 64.0 MiB");
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
    fn a_record_is_read_back_and_replaces_an_earlier_one() {
        let folder = TestFolder::new();
        let path = folder.path("exit.json");
        record().write(&path).unwrap();
        let second = ExitRecord { killed: None, code: Some(0), signal: None, ..record() };
        second.write(&path).unwrap();
        assert_eq!(ExitRecord::read(&path).unwrap(), second);
        assert_eq!(fs::read_dir(folder.root()).unwrap().count(), 1);
    }

    #[test]
    fn an_invalid_record_is_refused() {
        let folder = TestFolder::new();
        let path = folder.path("exit.json");
        fs::write(&path, "{\"pid\": -1}").unwrap();
        assert_eq!(ExitRecord::read(&path).unwrap_err().kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn the_sentence_states_the_cause_of_the_end() {
        assert_eq!(record().sentence().unwrap(), "was in one wake for 0.35 s; the limit is 0.35 s");
        let crashed = ExitRecord { killed: None, signal: Some(11), ..record() };
        assert_eq!(crashed.sentence().unwrap(), "was ended by signal 11 (SIGSEGV)");
        let out_of_memory = |signal| {
            ExitRecord { out_of_memory: true, signal: Some(signal), ..crashed.clone() }
                .sentence()
                .unwrap()
        };
        assert_eq!(
            out_of_memory(6),
            "ended itself: it needed more memory than `memory` in [limits] allows"
        );
        assert_eq!(
            out_of_memory(9),
            "was killed by the kernel: its control group had no memory left"
        );
        assert_eq!(ExitRecord { code: Some(0), signal: None, ..crashed }.sentence(), None);
    }
}
