//! Formats log lines for users, like errors: `warning: ring full input=imu`.

use std::fmt;
use std::io;

use tracing::{Event, Level, Subscriber};
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

/// Standard error whose errors are ignored: without a reader the library would panic.
struct StderrWriter(io::Stderr);

impl io::Write for StderrWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _ = self.0.write_all(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
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
}
