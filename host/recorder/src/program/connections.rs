//! Receives the messages of the starter and of lambdas, with one thread for each: frames may arrive
//! in pieces, or not at all.

use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::Builder;

use gleaner_base::{Exit, Failure, hex};
use gleaner_journal::{JournalEntry, JournalHeader};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::link::{
    AddLambda, ControlMessage, ControlServer, LambdaLink, LambdaMessage, LambdaReplies, LinkError,
};
use gleaner_samples::Waker;
use sha2::{Digest, Sha256};
use tracing::warn;

use super::background::SystemHealth;

/// Maximum number of messages of one lambda that are queued for the loop; then its socket fills,
/// and then the lambda's own queue.
const INBOX: usize = 64;

/// An event for the loop, other than samples and messages of lambdas.
pub enum LoopEvent {
    Registered(Box<Registration>),
    /// A lambda was announced and refused; the reason was sent to it.
    Refused,
    /// The loop has to end: the starter sent stop, has ended, or made a protocol error.
    Stop,
    /// The loop has to end, and the lambdas join another recorder.
    GiveWay,
    /// Definitions of a topic on this machine, by the id of its grant.
    Definitions {
        id: u32,
        text: Option<Arc<str>>,
    },
    /// The checks of each second.
    Health(SystemHealth),
}

/// An announced lambda, and its connection.
pub struct Registration {
    pub manifest: Manifest,
    pub remaps: Vec<(String, String)>,
    pub grants: Vec<(String, u32)>,
    pub inbox: Receiver<LambdaEvent>,
    pub replies: LambdaReplies,
}

pub enum LambdaEvent {
    /// The header of the lambda matches the announcement.
    Hello(Box<JournalHeader>),
    /// The header of the lambda differs from the announcement in this way.
    Mismatch(String),
    Wake {
        entry: Box<JournalEntry>,
        decided_ns: i64,
        missing: u32,
        encoded: Vec<u8>,
    },
    /// The engine, in place of that in the header.
    Engine(String),
    Closed(Option<LinkError>),
}

/// Receives messages of the starter until it ends.
pub fn starter(control: OwnedFd, events: SyncSender<LoopEvent>, bell: Waker) -> io::Result<()> {
    Builder::new().name("starter".to_owned()).spawn(move || {
        let mut control = ControlServer::new(control);
        loop {
            let event = match control.receive() {
                Ok(Some(ControlMessage::Add(add, socket))) => register(*add, socket, &bell)
                    .map_or(LoopEvent::Refused, |registration| {
                        LoopEvent::Registered(Box::new(registration))
                    }),
                Ok(Some(ControlMessage::Stop) | None) => LoopEvent::Stop,
                Ok(Some(ControlMessage::GiveWay)) => LoopEvent::GiveWay,
                Err(error) => {
                    warn!(
                        error = &error as &dyn std::error::Error,
                        "protocol error on the control connection"
                    );
                    LoopEvent::Stop
                }
            };
            let is_last = matches!(event, LoopEvent::Stop | LoopEvent::GiveWay);
            if events.send(event).is_err() || is_last {
                return bell.ring();
            }
            bell.ring();
        }
    })?;
    Ok(())
}

fn register(add: AddLambda, socket: OwnedFd, bell: &Waker) -> Option<Registration> {
    let lambda = add.lambda.display().to_string();
    let (link, mut replies) = match LambdaLink::new(socket) {
        Ok(both) => both,
        Err(error) => {
            warn!(%lambda, %error, "cannot use the socket of a lambda");
            return None;
        }
    };
    let (manifest, digest) = match load(&add) {
        Ok(loaded) => loaded,
        Err(failure) => {
            warn!(%lambda, %failure, "cannot record for a lambda");
            replies.refused(&failure.message);
            return None;
        }
    };
    let expected =
        ExpectedLambda { manifest: manifest.clone(), digest, remaps: add.remaps.clone() };
    let (sender, inbox) = sync_channel(INBOX);
    let bell = bell.clone();
    let name = format!("link {}", manifest.lambda.name);
    let started =
        Builder::new().name(name).spawn(move || read_link(link, &expected, &sender, &bell));
    if let Err(error) = started {
        warn!(%lambda, %error, "cannot start the thread of a lambda");
        replies.refused("the recorder cannot start a thread for it");
        return None;
    }
    Some(Registration { manifest, remaps: add.remaps, grants: add.grants, inbox, replies })
}

fn read_link(
    mut link: LambdaLink,
    expected: &ExpectedLambda,
    inbox: &SyncSender<LambdaEvent>,
    bell: &Waker,
) {
    loop {
        let event = match link.receive() {
            Ok(Some(LambdaMessage::Hello(header))) => match expected.differs(&header) {
                None => LambdaEvent::Hello(header),
                Some(why) => LambdaEvent::Mismatch(why),
            },
            Ok(Some(LambdaMessage::Wake { entry, decided_ns, missing, encoded })) => {
                LambdaEvent::Wake { entry, decided_ns, missing, encoded }
            }
            Ok(Some(LambdaMessage::Engine(engine))) => LambdaEvent::Engine(engine),
            Ok(Some(LambdaMessage::Bye) | None) => LambdaEvent::Closed(None),
            Err(error) => LambdaEvent::Closed(Some(error)),
        };
        let is_last = matches!(event, LambdaEvent::Closed(_) | LambdaEvent::Mismatch(_));
        if inbox.send(event).is_err() || is_last {
            return bell.ring();
        }
        bell.ring();
    }
}

struct ExpectedLambda {
    manifest: Manifest,
    /// SHA-256 of its `lambda.toml`, in hexadecimal digits.
    digest: String,
    remaps: Vec<(String, String)>,
}

impl ExpectedLambda {
    fn differs(&self, header: &JournalHeader) -> Option<String> {
        let lambda = &self.manifest.lambda;
        let text = |what: &str, wanted: &str, found: &str| {
            (wanted != found).then(|| {
                format!("its {what} is `{found}`; the parent process announced `{wanted}`")
            })
        };
        let manifest = header.files.iter().find(|file| file.path == "lambda.toml");
        text("name", lambda.name.as_str(), &header.lambda)
            .or_else(|| text("version", lambda.version.as_ref(), &header.version))
            .or_else(|| text("kind", lambda.kind.as_str(), header.kind.as_str()))
            .or_else(|| {
                let found = manifest.map_or("missing", |file| &file.sha256);
                text("lambda.toml, by its digest,", &self.digest, found)
            })
            .or_else(|| {
                let is_other = header.remaps != self.remaps;
                is_other.then(|| {
                    "its topics are not remapped as the parent process announced".to_owned()
                })
            })
            .or_else(|| {
                let limits =
                    header.limits.describe().into_iter().zip(self.manifest.limits.describe());
                limits.into_iter().find_map(|((key, found), (_, wanted))| {
                    text(&format!("limit `{key}`"), &wanted, &found)
                })
            })
    }
}

/// Returns the manifest of a build with the limits of this vehicle, and the digest of its bytes.
fn load(add: &AddLambda) -> Result<(Manifest, String), Failure> {
    let build = BuildDir::of(&add.lambda);
    let text = Manifest::read(build.path())?;
    let mut manifest = Manifest::parse(&text, build.manifest_path())?;
    if manifest.record.is_none() {
        let message = format!("lambda `{}` has no [record]", manifest.lambda.name);
        return Err(Failure::new(Exit::Usage, message));
    }
    manifest.limits = manifest.limits.tightened_by(&add.most).0;
    Ok((manifest, hex(&Sha256::digest(text))))
}
