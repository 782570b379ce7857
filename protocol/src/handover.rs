//! Connections that a starter passes to a program that it starts.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::io::Errno;
use serde::{Deserialize, Serialize};

use crate::link::frame::{self, tag};
use crate::link::{
    FrameReceiver, Incoming, LinkError, ReceivedFrame, STARTER, send_frame, try_send_frame,
};

const PROGRAM: &str = "the started program";

/// Connections that a starter passes to a program over the socket that is its standard input.
///
/// The socket stays open: a later message can replace a connection, for example after a restart of
/// the ingress. Such a message has only those connections that are replaced.
#[derive(Debug, Default)]
pub struct Handover {
    /// Requests of the starter, to the recorder or the ingress.
    pub control: Option<OwnedFd>,
    /// The reader's end of its connection to the ingress.
    pub ingress: Option<OwnedFd>,
    /// The lambda's end of its connection to the recorder.
    pub recorder: Option<OwnedFd>,
    /// The lambda's end of its connection to `gleaner-inference`.
    pub inference: Option<OwnedFd>,
    /// The file in which `gleaner-inference` notes the models that it loads and runs.
    pub running: Option<OwnedFd>,
    /// The file of the key with which the recorder signs clips.
    pub key: Option<OwnedFd>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct HandoverText {
    version: String,
    /// The connections, in the order of the descriptors.
    connections: Vec<ConnectionName>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum ConnectionName {
    Control,
    Ingress,
    Recorder,
    Inference,
    Running,
    Key,
}

/// Option of a runtime whose starter passes the connection to `gleaner-inference` this way, without
/// its dashes.
pub const PASSES_INFERENCE: &str = "starter-passes-inference";

/// Version of the programs of an installation.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Largest number of connections in a message.
const CONNECTIONS: usize = 4;

impl Handover {
    /// Sends the connections. It waits while the other side does not read an earlier message.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the program has ended.
    pub fn send(&self, socket: impl AsFd) -> Result<(), LinkError> {
        let (frame, descriptors) = self.encode()?;
        send_frame(&socket, &frame, &descriptors, PROGRAM)
    }

    /// As [`send`](Self::send), but never waits.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the program has ended, [`LinkError::Full`] if it does not read:
    /// nothing may be sent to it after that.
    pub fn try_send(&self, socket: impl AsFd) -> Result<(), LinkError> {
        let (frame, descriptors) = self.encode()?;
        try_send_frame(&socket, &frame, &descriptors, PROGRAM)
    }

    fn encode(&self) -> Result<(Vec<u8>, Vec<BorrowedFd<'_>>), LinkError> {
        let all = [
            (ConnectionName::Control, &self.control),
            (ConnectionName::Ingress, &self.ingress),
            (ConnectionName::Recorder, &self.recorder),
            (ConnectionName::Inference, &self.inference),
            (ConnectionName::Running, &self.running),
            (ConnectionName::Key, &self.key),
        ];
        let (connections, descriptors): (Vec<ConnectionName>, Vec<BorrowedFd<'_>>) =
            all.iter().filter_map(|(name, fd)| Some((*name, fd.as_ref()?.as_fd()))).unzip();
        let text = HandoverText { version: VERSION.to_owned(), connections };
        Ok((frame::encode_json(tag::HANDOVER, &text, STARTER, PROGRAM)?, descriptors))
    }

    /// Waits for the next message of the starter.
    ///
    /// Exactly one message is read, so that a [`HandoverReceiver`] finds the next one.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoStarter`] if `socket` is no socket, [`LinkError::Gone`] if the starter has
    /// ended, [`LinkError::OtherVersion`] if it is of another version,
    /// [`LinkError::Malformed`] for names that do not match the descriptors.
    pub fn receive(socket: impl AsFd) -> Result<Handover, LinkError> {
        let received = FrameReceiver::new(STARTER, CONNECTIONS).wait(socket);
        let frame = match received {
            Ok(Some(frame)) => frame,
            Ok(None) => return Err(LinkError::Gone { peer: STARTER }),
            Err(LinkError::Socket { source, .. })
                if source.raw_os_error() == Some(Errno::NOTSOCK.raw_os_error()) =>
            {
                return Err(LinkError::NoStarter);
            }
            Err(error) => return Err(error),
        };
        Handover::of(frame)
    }

    fn of(frame: ReceivedFrame) -> Result<Handover, LinkError> {
        if frame.tag != tag::HANDOVER {
            return Err(LinkError::Unknown { peer: STARTER, tag: frame.tag });
        }
        let malformed = |reason| LinkError::Malformed { peer: STARTER, frame: "handover", reason };
        let HandoverText { version, connections: names } = frame.json(STARTER)?;
        if version != VERSION {
            return Err(LinkError::OtherVersion { peer: STARTER, version, own: VERSION });
        }
        let (named, descriptors) = (names.len(), frame.descriptors.len());
        if named != descriptors {
            let reason = format!("it names {named} connections and has {descriptors} descriptors");
            return Err(malformed(reason));
        }
        let mut handover = Handover::default();
        for (name, descriptor) in names.into_iter().zip(frame.descriptors) {
            let connection = match name {
                ConnectionName::Control => &mut handover.control,
                ConnectionName::Ingress => &mut handover.ingress,
                ConnectionName::Recorder => &mut handover.recorder,
                ConnectionName::Inference => &mut handover.inference,
                ConnectionName::Running => &mut handover.running,
                ConnectionName::Key => &mut handover.key,
            };
            if connection.replace(descriptor).is_some() {
                return Err(malformed(format!("it names {name:?} twice").to_lowercase()));
            }
        }
        Ok(handover)
    }

    /// Takes the connection `control`.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoConnection`] if the starter did not pass it.
    pub fn take_control(&mut self) -> Result<OwnedFd, LinkError> {
        self.control.take().ok_or(LinkError::NoConnection { name: "control" })
    }

    /// Takes the connection `ingress`.
    ///
    /// # Errors
    ///
    /// [`LinkError::NoConnection`] if the starter did not pass it.
    pub fn take_ingress(&mut self) -> Result<OwnedFd, LinkError> {
        self.ingress.take().ok_or(LinkError::NoConnection { name: "ingress" })
    }
}

/// Receives the messages after the first one, over the same socket. No call waits.
#[derive(Debug)]
pub struct HandoverReceiver {
    socket: OwnedFd,
    frames: FrameReceiver,
}

impl HandoverReceiver {
    /// Receives over the socket from which the first message was received.
    pub fn new(socket: OwnedFd) -> HandoverReceiver {
        HandoverReceiver { socket, frames: FrameReceiver::new(STARTER, CONNECTIONS) }
    }

    /// Returns the next message if it has arrived.
    ///
    /// # Errors
    ///
    /// Those of [`Handover::receive`]; nothing can be read after one.
    pub fn poll(&mut self) -> Result<Incoming<Handover>, LinkError> {
        self.frames.poll(&self.socket, Handover::of)
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::{Read, Write};
    use std::os::unix::net::UnixStream;

    use super::*;

    fn message(bytes: &[u8]) -> Result<Handover, LinkError> {
        let (mut starter_end, program_end) = UnixStream::pair().unwrap();
        starter_end.write_all(bytes).unwrap();
        drop(starter_end);
        Handover::receive(program_end)
    }

    /// A connection to pass: what is written to it arrives at the second stream.
    fn connection() -> (Option<OwnedFd>, UnixStream) {
        let (passed, own) = UnixStream::pair().unwrap();
        (Some(passed.into()), own)
    }

    fn is_connected(passed: OwnedFd, mut own: UnixStream) {
        UnixStream::from(passed).write_all(b"here").unwrap();
        let mut read = String::new();
        own.read_to_string(&mut read).unwrap();
        assert_eq!(read, "here");
    }

    #[test]
    fn each_connection_arrives_under_its_name_and_can_be_replaced_later() {
        let (starter_end, program_end) = UnixStream::pair().unwrap();
        let ((control, control_end), (ingress, ingress_end)) = (connection(), connection());
        Handover { control, ingress, ..Handover::default() }.send(&starter_end).unwrap();
        let (ingress, later_end) = connection();
        Handover { ingress, ..Handover::default() }.send(&starter_end).unwrap();

        let mut first = Handover::receive(&program_end).unwrap();
        is_connected(first.take_control().unwrap(), control_end);
        is_connected(first.take_ingress().unwrap(), ingress_end);
        assert!(first.recorder.is_none());
        assert_eq!(
            first.take_control().unwrap_err().to_string(),
            "the parent passed no connection `control`"
        );
        let mut later = Handover::receive(&program_end).unwrap();
        is_connected(later.take_ingress().unwrap(), later_end);
        drop(starter_end);
        assert!(matches!(Handover::receive(&program_end), Err(LinkError::Gone { .. })));
    }

    #[test]
    fn later_connections_are_received_without_a_wait_and_sent_without_one() {
        let (starter_end, program_end) = UnixStream::pair().unwrap();
        let mut receiver = HandoverReceiver::new(program_end.into());
        assert!(matches!(receiver.poll(), Ok(Incoming::Nothing)));
        let (ingress, own_end) = connection();
        Handover { ingress, ..Handover::default() }.try_send(&starter_end).unwrap();
        let Ok(Incoming::Message(mut later)) = receiver.poll() else { panic!("no message") };
        is_connected(later.take_ingress().unwrap(), own_end);
        // A program that does not read.
        let (ingress, _own_end) = connection();
        let handover = Handover { ingress, ..Handover::default() };
        starter_end.set_nonblocking(true).unwrap();
        while (&starter_end).write(&[0; 4096]).is_ok() {}
        let refused = handover.try_send(&starter_end).unwrap_err().to_string();
        assert_eq!(refused, "the started program does not read its messages");
        let (starter_end, program_end) = UnixStream::pair().unwrap();
        let mut receiver = HandoverReceiver::new(program_end.into());
        handover.try_send(&starter_end).unwrap();
        drop(starter_end);
        assert!(matches!(receiver.poll(), Ok(Incoming::Message(_))));
        assert!(matches!(receiver.poll(), Ok(Incoming::Ended)));
        let (starter_end, _) = UnixStream::pair().unwrap();
        assert!(matches!(handover.try_send(&starter_end), Err(LinkError::Gone { .. })));
    }

    #[test]
    fn invalid_messages_and_other_inputs_are_refused() {
        let refusal = |bytes: &[u8]| message(bytes).unwrap_err().to_string();
        let of = |version: &str, names: &str| {
            let text = format!(r#"{{"version":"{version}","connections":{names}}}"#);
            frame::encode(tag::HANDOVER, text.as_bytes())
        };
        let named = |names| of(VERSION, names);
        assert_eq!(
            refusal(&of("9.0.0", "[]")),
            format!("the parent is of version `9.0.0` of Gleaner, this program of {VERSION}")
        );
        assert_eq!(
            refusal(&named(r#"["control","ingress"]"#)),
            "frame `handover` from the parent is invalid: \
             it names 2 connections and has 0 descriptors"
        );
        assert!(refusal(&named(r#"["network"]"#)).contains("unknown variant `network`"));
        assert_eq!(refusal(&frame::encode(tag::STOP, &[])), "frame 2 from the parent is unknown");
        assert_eq!(refusal(b"gle"), "the parent has ended, or closed the connection");
        let no_socket = Handover::receive(File::open("/dev/null").unwrap()).unwrap_err();
        assert!(matches!(no_socket, LinkError::NoStarter), "{no_socket}");

        let (starter_end, program_end) = UnixStream::pair().unwrap();
        let (passed, _own) = connection();
        let passed = passed.unwrap();
        let twice = named(r#"["ingress","ingress"]"#);
        send_frame(&starter_end, &twice, &[passed.as_fd(), passed.as_fd()], PROGRAM).unwrap();
        let refused = Handover::receive(&program_end).unwrap_err().to_string();
        assert!(refused.ends_with("it names ingress twice"), "{refused}");
    }
}
