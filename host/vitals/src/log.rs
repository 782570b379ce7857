//! Log lines for people, as errors are: `warning: ring full input=imu`.

use std::fmt;
use std::io;

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

/// Has log lines go to standard error from now on; `GLEANER_LOG` says which, and else it is warnings.
pub fn prepare() {
    let wanted = std::env::var("GLEANER_LOG").unwrap_or_else(|_| "warn".to_owned());
    let filter = tracing_subscriber::EnvFilter::try_new(&wanted).unwrap_or_else(|error| {
        eprintln!("warning: GLEANER_LOG=`{wanted}` is no filter, `warn` is used: {error}");
        "warn".into()
    });
    // Fails only where a subscriber is set already, which then stays.
    let _ = tracing_subscriber::fmt()
        .with_ansi(false)
        .event_format(Plain)
        .with_env_filter(filter)
        .with_writer(|| Says(io::stderr()))
        .try_init();
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
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
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
