//! Starts peers, programs on other DDS implementations, and reads their output. `cargo xtask peers`
//! builds them.

pub mod message;

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::{Duration, Instant};

use serde::Deserialize;

use message::MessageType;

/// Maximum wait for a peer: far longer than needed, so that only a hang reaches it.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// The implementation of DDS.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum PeerKind {
    /// Cyclone DDS in C.
    Cyclone,
    /// Fast DDS in C++.
    Fast,
    /// Cyclone DDS in Python.
    Python,
    /// Cyclone DDS in C, on `ros_discovery_info` with Gids of this many bytes.
    Graph(usize),
}

/// A line that a peer prints.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum PeerEvent {
    /// The number of matched peers has changed.
    Matched {
        /// The current number.
        count: u32,
    },
    /// Readers have acknowledged all messages, or one has not in time: of a writer that keeps all,
    /// after each change of their number.
    Acked {
        /// True if all have.
        all: bool,
    },
    /// All requested messages were written.
    Written { count: u32 },
    /// A message was received.
    Sample {
        /// The message's number.
        seq: u32,
        /// Its stamp in ns.
        stamp: i64,
        /// See [`message::PeerMessage::sum`].
        sum: u32,
    },
    /// The nodes of a participant were received.
    Graph {
        /// The participant, in hex.
        gid: String,
        nodes: Vec<PeerNode>,
    },
}

/// A node, as announced by its participant.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct PeerNode {
    /// Namespace, such as `/gleaner`.
    pub namespace: String,
    /// Name, such as `hello`.
    pub name: String,
    /// Its readers, in hex.
    pub readers: Vec<String>,
    /// Its writers, in hex.
    pub writers: Vec<String>,
}

impl PeerKind {
    /// The reason why it cannot be started; `None` if it can.
    pub fn unavailable(self) -> Option<&'static str> {
        let is_built = self.files().iter().all(|file| file.is_file());
        (!is_built).then_some("no peers; run: cargo xtask peers")
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

    /// The program, without further arguments.
    pub fn command(self) -> Command {
        let files = self.files();
        let mut command = Command::new(&files[0]);
        command.args(&files[1..]);
        command
    }

    /// The program as a writer of messages of a type on a topic. `options` are further ones, such
    /// as `--count 200`.
    pub fn publisher(self, ty: MessageType, topic: &str, options: &str) -> Command {
        let mut command = self.command();
        command.args(["pub", ty.short_name(), topic]).args(options.split_whitespace());
        if let Some(size) = ty.size() {
            command.args(["--size", &size]);
        }
        // As documented for images: fragments of 63 KB instead of 1344 bytes.
        let settings = "<General><MaxMessageSize>65500B</MaxMessageSize>\
                        <FragmentSize>63000B</FragmentSize></General>";
        command.env("CYCLONEDDS_URI", settings);
        command
    }

    /// The program as a reader of messages of a type from a topic, keeping all of them.
    pub fn subscriber(self, ty: MessageType, topic: &str, options: &str) -> Command {
        let mut command = self.command();
        command
            .args(["sub", ty.short_name(), topic, "--depth", "0"])
            .args(options.split_whitespace());
        command
    }
}

/// A running peer, stopped on drop.
pub struct Peer {
    child: Child,
    stdin: Option<ChildStdin>,
    events: Receiver<PeerEvent>,
}

impl Peer {
    /// Starts it.
    pub fn start(mut command: Command) -> Self {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a peer starts");
        let stdout = BufReader::new(child.stdout.take().expect("its output is a pipe"));
        let (sender, events) = mpsc::channel();
        thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                match serde_json::from_str(&line) {
                    // The receiver may be gone.
                    Ok(event) => drop(sender.send(event)),
                    Err(error) => eprintln!("peer: {line} ({error})"),
                }
            }
        });
        let stdin = child.stdin.take();
        Self { child, stdin, events }
    }

    /// Waits for the first further event for which `wanted` returns a value.
    pub fn wait<T>(
        &mut self,
        what: &str,
        wanted: impl FnMut(PeerEvent) -> Option<T>,
    ) -> Result<T, String> {
        self.wait_for(PATIENCE, wanted).ok_or_else(|| {
            let state = self.child.try_wait().map(|ended| ended.map(|status| status.to_string()));
            format!("waiting for {what}: peer is silent; ended: {state:?}")
        })
    }

    /// Waits for the first further event for which `wanted` returns a value; `None` on timeout.
    pub fn wait_for<T>(
        &mut self,
        patience: Duration,
        mut wanted: impl FnMut(PeerEvent) -> Option<T>,
    ) -> Option<T> {
        let deadline = Instant::now() + patience;
        loop {
            let event = self
                .events
                .recv_timeout(deadline.saturating_duration_since(Instant::now()))
                .ok()?;
            if let Some(found) = wanted(event) {
                return Some(found);
            }
        }
    }

    /// Waits until it has written all requested messages.
    pub fn written(&mut self) -> Result<(), String> {
        self.wait("a peer to write", |event| {
            matches!(event, PeerEvent::Written { .. }).then_some(())
        })
    }

    /// Waits until it is connected to a peer.
    pub fn matched(&mut self) -> Result<(), String> {
        self.wait("a peer to be connected", |event| {
            matches!(event, PeerEvent::Matched { count: 1.. }).then_some(())
        })
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Its exit status as text; `None` while it runs.
    pub fn ended(&mut self) -> Option<String> {
        self.child
            .try_wait()
            .map_or_else(|error| Some(error.to_string()), |ended| Some(ended?.to_string()))
    }

    /// Kills it, so that it cannot leave the network properly.
    pub fn kill(mut self) {
        let _ = self.child.kill();
    }
}

impl Drop for Peer {
    /// Lets it end by itself, so that it leaves the network properly; kills it after 10 s.
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
