//! The output of the processes of a run: reports on standard output, text on standard error.

use std::io::{BufReader, Read};
use std::process::Child;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::SyncSender;
use std::thread;
use std::time::Instant;

use gleaner_base::visible;
use gleaner_protocol::Report;
use gleaner_protocol::ingress::IngressReport;
use gleaner_protocol::link::RecorderReport;
use serde::de::DeserializeOwned;

use crate::byte_rate::ByteRate;
use crate::inference::InferenceEvent;
use crate::lines::{next_report, pass_on};

pub(crate) const PIPES: u8 = 2;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ChildId {
    /// With the number of restarts, so that output of an earlier process is not taken for that of
    /// the current one.
    Ingress(u32),
    /// As of the ingress.
    Recorder(u32),
    Inference,
    /// This process.
    Supervisor,
    /// A process of a lambda, by its number in the group.
    Lambda(u32),
}

pub(crate) struct ChildOutput {
    pub(crate) from: ChildId,
    pub(crate) piece: OutputPiece,
}

/// Wakes the receiver. If that has no room, it is awake.
pub(crate) const NOTICE: ChildOutput =
    ChildOutput { from: ChildId::Supervisor, piece: OutputPiece::Notice };

pub(crate) enum OutputPiece {
    Runtime(Report),
    Recorder(RecorderReport),
    Ingress(IngressReport),
    Inference(InferenceEvent),
    /// The start of a line on standard output that cannot be parsed.
    Unparsable(String),
    /// A piece of standard error, with the prefix of its process at the start of a line.
    Stderr(Vec<u8>),
    Notice,
    /// One of its [`PIPES`] is closed.
    Closed,
}

/// Starts threads that send the output of `child` to `sender`, until its pipes are closed. `prefix`
/// comes before each line of standard error.
pub(crate) fn forward(
    child: &mut Child,
    (from, prefix): (ChildId, &str),
    sender: &SyncSender<ChildOutput>,
) {
    let send = |sender: SyncSender<ChildOutput>| {
        // Sending fails if the run has ended.
        move |piece| sender.send(ChildOutput { from, piece }).is_ok()
    };
    if let Some(reports) = child.stdout.take() {
        let send = send(sender.clone());
        thread::spawn(move || {
            match from {
                ChildId::Ingress(_) => follow(reports, OutputPiece::Ingress, &send),
                ChildId::Recorder(_) => follow(reports, OutputPiece::Recorder, &send),
                ChildId::Lambda(_) => follow(reports, OutputPiece::Runtime, &send),
                // Its service reads it, and the supervisor has no process here.
                ChildId::Inference | ChildId::Supervisor => {}
            }
            send(OutputPiece::Closed);
        });
    }
    if let Some(stderr) = child.stderr.take() {
        let (send, prefix) = (send(sender.clone()), prefix.to_owned());
        thread::spawn(move || {
            let mut begins_line = true;
            // Gleaner's other programs write what they choose.
            let mut rate = matches!(from, ChildId::Lambda(_)).then(ByteRate::new);
            let dropped = |bytes: u64, begins_line: bool| {
                let end = if begins_line { "" } else { "\n" };
                let text = format!("{end}{prefix}{bytes} bytes of standard error were dropped\n");
                send(OutputPiece::Stderr(text.into_bytes()));
            };
            pass_on(stderr, &AtomicBool::new(false), |text| {
                match rate.as_mut().map_or(Some(0), |rate| rate.take(text.len(), Instant::now())) {
                    None => return,
                    Some(0) => {}
                    Some(bytes) => {
                        dropped(bytes, begins_line);
                        begins_line = true;
                    }
                }
                let prefix = if begins_line { prefix.as_bytes() } else { b"" };
                send(OutputPiece::Stderr([prefix, text].concat()));
                begins_line = text.ends_with(b"\n");
            });
            if let Some(bytes @ 1..) = rate.as_mut().map(ByteRate::take_dropped) {
                dropped(bytes, begins_line);
            }
            send(OutputPiece::Closed);
        });
    }
}

fn follow<T: DeserializeOwned>(
    reports: impl Read,
    wrap: fn(T) -> OutputPiece,
    send: &impl Fn(OutputPiece) -> bool,
) {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).unwrap_or(false) {
        // A shim ends a line that its runtime left unfinished.
        if line == b"\n" {
            continue;
        }
        let unparsable = |_| {
            OutputPiece::Unparsable(visible(
                &String::from_utf8_lossy(&line).chars().take(200).collect::<String>(),
            ))
        };
        if !send(serde_json::from_slice(&line).map_or_else(unparsable, wrap)) {
            return;
        }
    }
}
