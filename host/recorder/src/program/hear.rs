//! What the starter and the lambdas say, on its way to the loop. A thread each: their frames may
//! come in pieces, or not at all.

use std::io;
use std::os::fd::OwnedFd;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{Builder, Thread};

use gleaner_base::{Exit, Failure, hex};
use gleaner_journal::{Entry, Header};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::link::{Add, Answers, Controlled, Heard, LambdaLink, LinkError, Order};
use sha2::{Digest, Sha256};
use tracing::warn;

use super::watch::Seen;

/// What one lambda said waits for the loop, up to this; then its socket waits, and then the
/// lambda's own queue.
const SPOKEN: usize = 64;

/// What the loop hears beside samples and lambdas.
pub(super) enum Event {
    /// A lambda will come.
    Announced(Box<Announced>),
    /// One was announced, and refused; it was said why.
    Refused,
    /// It is to end: the starter said so, or has ended, or speaks nonsense.
    Stop,
    /// From the watch.
    Seen(Seen),
}

/// A lambda that will come, and how it is heard.
pub(super) struct Announced {
    pub(super) manifest: Manifest,
    pub(super) remaps: Vec<(String, String)>,
    pub(super) spoken: Receiver<Spoken>,
    pub(super) answers: Answers,
}

/// What a lambda said.
pub(super) enum Spoken {
    /// What it is: what was announced.
    Hello(Box<Header>),
    /// It is something else.
    Another(String),
    Wake {
        entry: Box<Entry>,
        decided_ns: i64,
        missing: u32,
        bytes: usize,
    },
    /// Nothing more comes.
    Gone(Option<LinkError>),
}

/// Hears the starter until it ends.
pub(super) fn starter(
    control: OwnedFd,
    events: SyncSender<Event>,
    reader: Thread,
) -> io::Result<()> {
    Builder::new().name("starter".to_owned()).spawn(move || {
        let mut control = Controlled::new(control);
        loop {
            let event = match control.order() {
                Ok(Some(Order::Add(add, socket))) => announced(add, socket, &reader)
                    .map_or(Event::Refused, |announced| Event::Announced(Box::new(announced))),
                Ok(Some(Order::Stop) | None) => Event::Stop,
                Err(error) => {
                    warn!(
                        error = &error as &dyn std::error::Error,
                        "the starter cannot be understood"
                    );
                    Event::Stop
                }
            };
            let is_last = matches!(event, Event::Stop);
            if events.send(event).is_err() || is_last {
                return reader.unpark();
            }
            reader.unpark();
        }
    })?;
    Ok(())
}

fn announced(add: Add, socket: OwnedFd, reader: &Thread) -> Option<Announced> {
    let lambda = add.lambda.display().to_string();
    let (link, mut answers) = match LambdaLink::new(socket) {
        Ok(both) => both,
        Err(error) => {
            warn!(%lambda, %error, "a lambda's socket cannot be used");
            return None;
        }
    };
    let (manifest, digest) = match load(&add) {
        Ok(loaded) => loaded,
        Err(failure) => {
            warn!(%lambda, %failure, "a lambda cannot be recorded for");
            answers.refused(&failure.message);
            return None;
        }
    };
    let expected = Expected { manifest: manifest.clone(), digest, remaps: add.remaps.clone() };
    let (sender, spoken) = sync_channel(SPOKEN);
    let reader = reader.clone();
    let name = format!("hear {}", manifest.lambda.name);
    let heard = Builder::new().name(name).spawn(move || hear(link, &expected, &sender, &reader));
    if let Err(error) = heard {
        warn!(%lambda, %error, "a lambda cannot be heard");
        answers.refused("the recorder has no thread for it");
        return None;
    }
    Some(Announced { manifest, remaps: add.remaps, spoken, answers })
}

fn hear(mut link: LambdaLink, expected: &Expected, spoken: &SyncSender<Spoken>, reader: &Thread) {
    loop {
        let said = match link.hear() {
            Ok(Some(Heard::Hello(header))) => match expected.differs(&header) {
                None => Spoken::Hello(header),
                Some(why) => Spoken::Another(why),
            },
            Ok(Some(Heard::Wake { entry, decided_ns, missing, bytes })) => {
                Spoken::Wake { entry, decided_ns, missing, bytes }
            }
            Ok(Some(Heard::Bye) | None) => Spoken::Gone(None),
            Err(error) => Spoken::Gone(Some(error)),
        };
        let is_last = matches!(said, Spoken::Gone(_) | Spoken::Another(_));
        if spoken.send(said).is_err() || is_last {
            return reader.unpark();
        }
        reader.unpark();
    }
}

/// What the starter said that a lambda is.
struct Expected {
    manifest: Manifest,
    /// Of its `lambda.toml`, in hexadecimal digits.
    digest: String,
    remaps: Vec<(String, String)>,
}

impl Expected {
    /// In which way `header` is of another lambda.
    fn differs(&self, header: &Header) -> Option<String> {
        let lambda = &self.manifest.lambda;
        let text = |what: &str, wanted: &str, found: &str| {
            (wanted != found)
                .then(|| format!("its {what} is `{found}`; the recorder was told of `{wanted}`"))
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
                    "its topics are remapped in another way than the recorder was told".to_owned()
                })
            })
            .or_else(|| {
                let limits =
                    header.limits.in_words().into_iter().zip(self.manifest.limits.in_words());
                limits.into_iter().find_map(|((key, found), (_, wanted))| {
                    text(&format!("limit `{key}`"), &wanted, &found)
                })
            })
    }
}

/// The manifest of a build with the limits that it gets on this vehicle, and its digest: of the
/// same bytes.
fn load(add: &Add) -> Result<(Manifest, String), Failure> {
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
