//! Programs on other people's DDS: starting one, and hearing what it says. `cargo xtask peers`
//! builds them.

pub mod message;

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};

use serde::Deserialize;

use message::Type;

/// How long a peer may take for anything: far longer than it does, so that only one that hangs is
/// caught.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Whose DDS it is.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Cyclone DDS in C.
    Cyclone,
    /// Fast DDS in C++.
    Fast,
    /// Cyclone DDS in Python.
    Python,
    /// Cyclone DDS in C, on `ros_discovery_info` with Gids of so many bytes.
    Graph(usize),
}

/// One line of a peer.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum Said {
    /// It is connected to so many.
    Matched {
        /// How many there are now.
        count: u32,
    },
    /// It has written all that it was asked for.
    Written {
        /// How many those were.
        count: u32,
    },
    /// It has received a message.
    Sample {
        /// The message's number.
        seq: u32,
        /// Its stamp in ns.
        stamp: i64,
        /// See [`message::Message::sum`].
        sum: u32,
    },
    /// It has heard of a participant's nodes.
    Graph {
        /// The participant, in hex.
        gid: String,
        /// Its nodes.
        nodes: Vec<Node>,
    },
}

/// A node, as a participant tells of it.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Node {
    /// Such as `/gleaner`.
    pub namespace: String,
    /// Such as `hello`.
    pub name: String,
    /// Its readers, in hex.
    pub readers: Vec<String>,
    /// Its writers, in hex.
    pub writers: Vec<String>,
}

impl Kind {
    /// Why it cannot be started; `None` if it can.
    pub fn unavailable(self) -> Option<&'static str> {
        if self.files().iter().all(|file| file.is_file()) {
            None
        } else {
            Some("no peers; run: cargo xtask peers")
        }
    }

    fn files(self) -> Vec<PathBuf> {
        let test = std::env::current_exe().expect("a test has a path");
        // target/release/deps/test-0123
        let target = test.ancestors().nth(3).expect("a test lies in a target folder");
        let built = |name: &str| target.join("peers").join(name);
        match self {
            Self::Cyclone => vec![built("cyclone-peer")],
            Self::Fast => vec![built("fast-peer")],
            Self::Python => {
                vec![built("venv/bin/python3"), crate::root().join("tests/peers/python/peer.py")]
            }
            Self::Graph(bytes) => vec![built(&format!("cyclone-graph-{bytes}"))],
        }
    }

    /// The program, without arguments of its own.
    pub fn command(self) -> Command {
        let files = self.files();
        let mut command = Command::new(&files[0]);
        command.args(&files[1..]);
        command
    }

    /// The program, to write messages of a type on a topic. `options` are further ones, such as
    /// `--count 200`.
    pub fn publisher(self, ty: Type, topic: &str, options: &str) -> Command {
        let mut command = self.command();
        command.args(["pub", ty.short_name(), topic]).args(options.split_whitespace());
        if let Some(size) = ty.size() {
            command.args(["--size", &size]);
        }
        // As people are told to do for images: fragments of 63 KB instead of 1344 bytes.
        let settings = "<General><MaxMessageSize>65500B</MaxMessageSize><FragmentSize>63000B</FragmentSize></General>";
        command.env("CYCLONEDDS_URI", settings);
        command
    }

    /// The program, to read messages of a type from a topic, without forgetting any.
    pub fn subscriber(self, ty: Type, topic: &str, options: &str) -> Command {
        let mut command = self.command();
        command
            .args(["sub", ty.short_name(), topic, "--depth", "0"])
            .args(options.split_whitespace());
        command
    }
}

/// A peer that runs. It is ended with this.
pub struct Peer {
    child: Child,
    stdin: Option<ChildStdin>,
    said: Receiver<Said>,
}

impl Peer {
    /// Starts it.
    ///
    /// # Panics
    ///
    /// If the program is not there; see [`Kind::unavailable`].
    pub fn start(mut command: Command) -> Self {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a peer starts");
        let stdout = BufReader::new(child.stdout.take().expect("its output is a pipe"));
        let (say, said) = mpsc::channel();
        thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                match serde_json::from_str(&line) {
                    // Nobody has to listen to the end.
                    Ok(event) => drop(say.send(event)),
                    Err(error) => eprintln!("peer: {line} ({error})"),
                }
            }
        });
        let stdin = child.stdin.take();
        Self { child, stdin, said }
    }

    /// The next thing it says that `wanted` makes something of.
    ///
    /// # Errors
    ///
    /// In words, if it ends or is silent for too long.
    pub fn wait<T>(
        &mut self,
        what: &str,
        wanted: impl FnMut(Said) -> Option<T>,
    ) -> Result<T, String> {
        self.wait_for(PATIENCE, wanted).ok_or_else(|| {
            let state = self.child.try_wait().map(|ended| ended.map(|status| status.to_string()));
            format!("waiting for {what}: peer is silent; ended: {state:?}")
        })
    }

    /// What `wanted` makes of the next lines; `None` if none of them comes in time.
    pub fn wait_for<T>(
        &mut self,
        patience: Duration,
        mut wanted: impl FnMut(Said) -> Option<T>,
    ) -> Option<T> {
        let deadline = Instant::now() + patience;
        loop {
            let said =
                self.said.recv_timeout(deadline.saturating_duration_since(Instant::now())).ok()?;
            if let Some(found) = wanted(said) {
                return Some(found);
            }
        }
    }

    /// Waits until it has written all that it was asked for.
    ///
    /// # Errors
    ///
    /// As [`wait`](Self::wait).
    pub fn written(&mut self) -> Result<(), String> {
        self.wait("a peer to write", |said| matches!(said, Said::Written { .. }).then_some(()))
    }

    /// Waits until it is connected to somebody.
    ///
    /// # Errors
    ///
    /// As [`wait`](Self::wait).
    pub fn matched(&mut self) -> Result<(), String> {
        self.wait("a peer to be connected", |said| {
            matches!(said, Said::Matched { count: 1.. }).then_some(())
        })
    }

    /// How it ended, in words; `None` while it runs.
    pub fn ended(&mut self) -> Option<String> {
        self.child
            .try_wait()
            .map_or_else(|error| Some(error.to_string()), |ended| Some(ended?.to_string()))
    }

    /// Ends it at once, without its knowing.
    pub fn kill(mut self) {
        let _ = self.child.kill();
    }
}

impl Drop for Peer {
    /// Lets it end by itself, so that it says goodbye to others; one that does not is killed.
    fn drop(&mut self) {
        drop(self.stdin.take());
        let deadline = Instant::now() + Duration::from_secs(10);
        while matches!(self.child.try_wait(), Ok(None)) {
            if Instant::now() > deadline {
                let _ = self.child.kill();
                let _ = self.child.wait();
                return;
            }
            thread::sleep(Duration::from_millis(5));
        }
    }
}
