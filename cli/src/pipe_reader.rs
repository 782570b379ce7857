//! Reads the output of a child process without waiting forever for its end: processes that the
//! child left running may hold the pipe open.

use std::process::Child;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time::Duration;

/// Time after the child's end to read the rest of its pipe: ample for the few kilobytes that a pipe
/// holds, and short for a user if another process holds the pipe open.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(2);

/// Interval of checks whether the child still runs.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// A thread that reads a pipe and returns a result. If the reader gives up, the thread is detached.
pub(crate) struct PipeReader<T> {
    result: Receiver<T>,
}

impl<T: Send + 'static> PipeReader<T> {
    /// Starts a thread that runs `read`, which reads a pipe and returns a result.
    pub(crate) fn start(read: impl FnOnce() -> T + Send + 'static) -> PipeReader<T> {
        let (sender, result) = mpsc::channel();
        // Sending fails if the caller has given up.
        thread::spawn(move || drop(sender.send(read())));
        PipeReader { result }
    }

    /// Waits for the result; `None` if `child` has ended and the pipe is still open after
    /// [`DRAIN_TIMEOUT`].
    pub(crate) fn wait(self, child: &mut Child) -> Option<T> {
        loop {
            match self.result.recv_timeout(CHECK_INTERVAL) {
                Ok(result) => return Some(result),
                Err(RecvTimeoutError::Disconnected) => return None,
                // A child whose status cannot be read is treated as ended.
                Err(RecvTimeoutError::Timeout) if !matches!(child.try_wait(), Ok(None)) => {
                    return self.drain();
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    /// Waits for the result after the child has ended; `None` if the pipe is still open after
    /// [`DRAIN_TIMEOUT`].
    pub(crate) fn drain(self) -> Option<T> {
        self.result.recv_timeout(DRAIN_TIMEOUT).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::io::{self, Read, Write};

    use super::*;

    /// Starts a reader that returns the whole text at the end of the pipe.
    fn text_reader(mut stream: impl Read + Send + 'static) -> PipeReader<String> {
        PipeReader::start(move || {
            let mut text = String::new();
            stream.read_to_string(&mut text).map(|_| text).unwrap_or_default()
        })
    }

    #[test]
    fn everything_written_before_the_end_is_read() {
        let (stream, mut writer) = io::pipe().unwrap();
        let reader = text_reader(stream);
        writer.write_all(b"error: no such drive\n  help:  name one").unwrap();
        drop(writer);
        assert_eq!(reader.drain().unwrap(), "error: no such drive\n  help:  name one");
    }

    #[test]
    fn a_pipe_that_stays_open_is_given_up() {
        let (stream, writer) = io::pipe().unwrap();
        assert_eq!(text_reader(stream).drain(), None);
        drop(writer);
    }
}
