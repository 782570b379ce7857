//! What every run of a lambda needs, be it over drives or live: what was asked for, rings that a
//! transport fills, a guest that sees them, and the files of its decisions.

mod asked;

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Explain, Failure, visible};
use gleaner_lambda::Fault;
use gleaner_lambda::manifest::Manifest;
use gleaner_transport::{Transport, TransportError};

pub use asked::{Asked, AskedArgs, tighten};
pub use gleaner_lambda::{LOCK, Output, OutputError, RESULTS};

use crate::api::Session;
use crate::api::data::Topic;
use crate::api::log::Line;
use crate::guest::Guest;
use crate::input::{InputError, Live, open_inputs};

/// Makes the guest of a lambda whose kind the caller can host.
pub type Load<'a> =
    &'a mut dyn FnMut(&Asked, &Manifest, Session, Bounds) -> Result<Box<dyn Guest>, Failure>;

/// What bounds a wake beside fuel and memory.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Bounds {
    /// Nothing: a deadline would make decisions depend on the machine.
    Replay,
    /// A deadline for each wake.
    Live(Duration),
}

/// A lambda before its `init`, over a transport that has not begun.
pub struct Stage {
    /// The lambda's topics, in the order of its manifest.
    pub inputs: Vec<Arc<Topic>>,
    /// What it sees and causes.
    pub session: Session,
    /// What runs it.
    pub guest: Box<dyn Guest>,
}

impl Stage {
    /// Opens the inputs and loads the lambda. `live` says what differs where samples arrive while
    /// it runs.
    ///
    /// # Errors
    ///
    /// Why it cannot start.
    pub fn set(
        transport: &mut dyn Transport,
        asked: &Asked,
        manifest: &Manifest,
        bounds: Bounds,
        live: Option<&Live>,
        load: Load<'_>,
    ) -> Result<Self, Failure> {
        let inputs = open_inputs(manifest, &asked.remaps, transport, live).map_err(|error| {
            Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error)
        })?;
        let session = Session::new(inputs.clone(), asked.config.clone(), &manifest.limits);
        let guest = load(asked, manifest, session.clone(), bounds)?;
        Ok(Self { inputs, session, guest })
    }
}

/// What a lambda's fault in `init` means for a run. What it `said` on the way may be why: what of
/// that is in no file goes to standard error.
pub fn not_started(lambda: &str, fault: Fault, said: &[Line]) -> Failure {
    said.iter().for_each(|line| eprintln!("log: {}", visible(&line.message)));
    let mut failure = Failure::new(Exit::LambdaFaulted, format!("cannot start lambda `{lambda}`"));
    failure.causes = vec![fault.message];
    failure
}

impl Explain for InputError {
    fn help(&self) -> Option<String> {
        let Self::Subscribe { source, .. } = self else {
            return Some("lower depth, hold or max_size of this [[input]]".to_owned());
        };
        Some(match source {
            TransportError::NoSuchTopic { .. } => "correct `topic` in lambda.toml, or pass --remap FROM:=TO".to_owned(),
            TransportError::WrongType { found, .. } => {
                format!("write type = \"{found}\" in lambda.toml, or choose another topic")
            }
            TransportError::Encoding { what: "schema encoding", .. } => {
                "put the .msg files of the type, and of those it refers to, into DIR/msg, and build again".to_owned()
            }
            _ => return None,
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Subscribe { .. } => Exit::Usage,
            Self::Layout { .. } | Self::Memory { .. } => Exit::Internal,
        }
    }
}
