//! Log lines for people, as errors are: `warning: ring full input=imu`.

use std::fmt;
use std::io;

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields, layer};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;

/// Has log lines go to standard error from now on; `GLEANER_LOG` says which, and else it is
/// warnings.
pub fn prepare() {
    let wanted = std::env::var("GLEANER_LOG").unwrap_or_else(|_| "warn".to_owned());
    // Not `EnvFilter`, which also filters by spans and values, of which we have none: that takes a
    // library for regular expressions.
    let filter = wanted.parse().unwrap_or_else(|error| {
        eprintln!("warning: GLEANER_LOG=`{wanted}` is no filter, `warn` is used: {error}");
        Targets::new().with_default(Level::WARN)
    });
    let lines = layer().with_ansi(false).event_format(Plain).with_writer(|| Says(io::stderr()));
    // Fails only where a subscriber is set already, which then stays.
    let _ = tracing_subscriber::registry().with(lines).with(filter).try_init();
}

/// Standard error, which nobody may read any more: the library would panic about that.
struct Says(io::Stderr);

impl io::Write for Says {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _ = self.0.write_all(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// One line for people, as errors are: `warning: ring full input=imu`.
struct Plain;

impl<S, N> FormatEvent<S, N> for Plain
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
            Level::ERROR => "trouble",
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
