//! Hearing out a program without depending on it to close its streams: what it left running may
//! hold them open.

use std::process::Child;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time::Duration;

/// How long after a program's end its streams may still bring something. What it wrote lies in a
/// pipe of some kilobytes by then: this is ample for them, and short for a person who waits because
/// another process holds the pipe.
const REST: Duration = Duration::from_secs(2);

/// How often to ask whether the program still runs, while nothing else tells.
const ASK: Duration = Duration::from_millis(50);

/// Work on a thread of its own that ends with a stream, or before. The thread of one that is given
/// up is left behind.
pub(crate) struct Listener<T> {
    heard: Receiver<T>,
}

impl<T: Send + 'static> Listener<T> {
    /// Starts `listen`, which reads a stream and says what it heard.
    pub(crate) fn start(listen: impl FnOnce() -> T + Send + 'static) -> Listener<T> {
        let (say, heard) = mpsc::channel();
        // If nobody waits for it any more, it is not wanted.
        thread::spawn(move || drop(say.send(listen())));
        Listener { heard }
    }

    /// What was heard, as soon as it was heard; `None` if `child` ended meanwhile and a moment
    /// later it was not.
    pub(crate) fn until_the_end_of(self, child: &mut Child) -> Option<T> {
        loop {
            match self.heard.recv_timeout(ASK) {
                Ok(heard) => return Some(heard),
                Err(RecvTimeoutError::Disconnected) => return None,
                // One that cannot be asked will not be waited for.
                Err(RecvTimeoutError::Timeout) if !matches!(child.try_wait(), Ok(None)) => {
                    return self.rest();
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    /// What was heard of a program that has ended; `None` if a moment later the stream is still
    /// open.
    pub(crate) fn rest(self) -> Option<T> {
        self.heard.recv_timeout(REST).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::io::{self, Read, Write};

    use super::*;

    /// A listener that collects what it hears, and gives the whole at the end.
    fn listener(mut stream: impl Read + Send + 'static) -> Listener<String> {
        Listener::start(move || {
            let mut text = String::new();
            stream.read_to_string(&mut text).map(|_| text).unwrap_or_default()
        })
    }

    #[test]
    fn the_last_words_are_heard() {
        let (stream, mut says) = io::pipe().unwrap();
        let listener = listener(stream);
        says.write_all(b"error: no such drive\n  help:  name one").unwrap();
        drop(says);
        assert_eq!(listener.rest().unwrap(), "error: no such drive\n  help:  name one");
    }

    #[test]
    fn a_stream_that_somebody_holds_open_is_given_up() {
        let (stream, says) = io::pipe().unwrap();
        assert_eq!(listener(stream).rest(), None);
        drop(says);
    }
}
