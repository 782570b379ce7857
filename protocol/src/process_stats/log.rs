//! Formats log lines for users, like errors: `warning: ring full input=imu`.

use std::fmt::{self, Display};
use std::io::{self, Write};
use std::sync::{Mutex, PoisonError};

use crate::{Holds, Layer};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, Mode, OFlags, fstat, open};
use rustix::stdio::{dup2_stderr, stderr};
use tracing::{Event, Level, Subscriber, debug, warn};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields, layer};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;

/// Sends log lines to standard error. `GLEANER_LOG` is the filter; the default is `warn`.
pub fn init() {
    let wanted = std::env::var("GLEANER_LOG").unwrap_or_else(|_| "warn".to_owned());
    // Not `EnvFilter`: it also filters by spans and values, which Gleaner does not use, and needs a
    // library for regular expressions.
    let filter = wanted.parse().unwrap_or_else(|error| {
        eprintln!("warning: GLEANER_LOG=`{wanted}` is not a filter; using `warn`: {error}");
        Targets::new().with_default(Level::WARN)
    });
    let lines = layer()
        .with_ansi(false)
        .event_format(PlainFormat)
        .with_writer(|| StderrWriter(io::stderr()));
    // Fails only if a subscriber is set already, which then stays.
    let _ = tracing_subscriber::registry().with(lines).with(filter).try_init();
}

/// Reports the layers of the sandbox of this process: in one line, those that are missing.
pub fn layers(layers: impl IntoIterator<Item = Layer>) {
    let mut missing = Vec::new();
    for layer in layers {
        debug!(?layer, "sandbox");
        if layer.holds == Holds::No {
            missing.push(format!("{} ({})", layer.name, layer.note));
        }
    }
    if !missing.is_empty() {
        let missing = missing.join(", ");
        warn!(missing, "some sandbox layers are missing in this process; see `gleaner doctor`");
    }
}

/// Sends log lines to standard error as [`init`] does, for a process that serves others: it never
/// waits for a starter that does not read. Lines without room are dropped, and the next line that
/// has room is preceded by their number.
pub fn init_service() {
    init();
    if let Err(error) = open_without_waiting() {
        tracing::debug!(%error, "log lines may block while the parent process does not read them");
    }
}

/// Prints the failure that ends a program. Waits a moment for room: it is the last line.
pub fn failure(failure: impl Display) {
    let wait = Timespec { tv_sec: 2, tv_nsec: 0 };
    let _ = poll(&mut [PollFd::new(&stderr(), PollFlags::OUT)], Some(&wait));
    let _ = StderrWriter(io::stderr()).write(format!("{failure}\n").as_bytes());
}

/// Lets writes to standard error fail that would wait, those of libraries, too. The pipe is opened
/// again, as the flag of the present description also holds for its other owners.
fn open_without_waiting() -> io::Result<()> {
    if FileType::from_raw_mode(fstat(stderr())?.st_mode) == FileType::Fifo {
        let flags = OFlags::WRONLY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        dup2_stderr(open("/proc/self/fd/2", flags, Mode::empty())?)?;
    }
    Ok(())
}

/// Lines without room, of all threads.
static LINES: Mutex<LineWriter> = Mutex::new(LineWriter { dropped: 0, is_cut: false });

/// Standard error whose errors are ignored: without a reader the library would panic.
struct StderrWriter(io::Stderr);

impl io::Write for StderrWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        LINES.lock().unwrap_or_else(PoisonError::into_inner).write(&mut self.0, bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes lines whole or not at all, and counts those without room.
struct LineWriter {
    /// Lines without room since the last one that had some.
    dropped: u64,
    /// Set if the last one was cut off, as a pipe may do with more than 4 KiB.
    is_cut: bool,
}

impl LineWriter {
    fn write(&mut self, to: &mut impl Write, line: &[u8]) {
        if self.dropped > 0 {
            let begin = if self.is_cut { "\n" } else { "" };
            let text = "log lines dropped: standard error was not read";
            let notice = format!("{begin}warning: {text} dropped={}\n", self.dropped);
            if !self.has_room(to, notice.as_bytes()) {
                self.dropped += 1;
                return;
            }
            self.dropped = 0;
        }
        self.dropped += u64::from(!self.has_room(to, line));
    }

    /// Writes bytes; returns false if they have no room. Other errors are ignored.
    fn has_room(&mut self, to: &mut impl Write, bytes: &[u8]) -> bool {
        let mut rest = bytes;
        while !rest.is_empty() {
            match to.write(rest) {
                Ok(0) => break,
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.is_cut |= rest.len() < bytes.len();
                    return false;
                }
                Err(_) => break,
            }
        }
        self.is_cut = false;
        true
    }
}

/// Formats an event as one line for users.
struct PlainFormat;

impl<S, N> FormatEvent<S, N> for PlainFormat
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let level = match *event.metadata().level() {
            // Not "error": lines that begin with `error: ` are failures that end a program.
            Level::ERROR => "critical",
            Level::WARN => "warning",
            Level::INFO => "info",
            Level::DEBUG => "debug",
            Level::TRACE => "trace",
        };
        write!(writer, "{level}: ")?;
        context.field_format().format_fields(writer.by_ref(), event)?;
        writeln!(writer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filter_is_a_level_or_a_level_for_each_part_of_a_program() {
        let lets_through = |wanted: &str, target: &str, level: Level| {
            wanted.parse::<Targets>().expect("a filter").would_enable(target, &level)
        };
        assert!(lets_through("debug", "gleaner_host::live", Level::DEBUG));
        assert!(!lets_through("warn", "gleaner_host::live", Level::INFO));
        assert!(lets_through("warn,gleaner_host=trace", "gleaner_host::live", Level::TRACE));
        assert!(!lets_through("warn,gleaner_host=trace", "rustdds::dds", Level::INFO));
        assert!(!lets_through("off", "gleaner_host::live", Level::ERROR));
        assert!("gleaner_host=loud".parse::<Targets>().is_err());
    }

    struct NarrowPipe {
        text: Vec<u8>,
        room: usize,
    }

    impl Write for NarrowPipe {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let length = bytes.len().min(self.room);
            if length == 0 {
                return Err(io::ErrorKind::WouldBlock.into());
            }
            self.text.extend(&bytes[..length]);
            self.room -= length;
            Ok(length)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn lines_without_room_are_dropped_and_counted_before_the_next_one() {
        let mut lines = LineWriter { dropped: 0, is_cut: false };
        let mut pipe = NarrowPipe { text: Vec::new(), room: 6 };
        for line in ["one\n", "two\n", "three\n"] {
            lines.write(&mut pipe, line.as_bytes());
        }
        pipe.room = 200;
        lines.write(&mut pipe, b"four\n");
        lines.write(&mut pipe, b"five\n");
        let text = String::from_utf8(pipe.text).unwrap();
        let notice = "warning: log lines dropped: standard error was not read dropped=2";
        assert_eq!(text, format!("one\ntw\n{notice}\nfour\nfive\n"));
    }
}
