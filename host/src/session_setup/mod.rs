//! Sets up a lambda's session, over drives or live: its arguments, the rings that a transport
//! fills, and the guest that reads them. Also re-exports the writer of its decisions.

mod lambda_args;

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Explain, Failure, visible};
use gleaner_lambda::Fault;
use gleaner_lambda::manifest::Manifest;
use gleaner_transport::{Transport, TransportError};

pub use gleaner_lambda::{LOCK, Output, OutputError, RESULTS};
pub use lambda_args::{ConfiguredLambda, LambdaArgs, tighten};

use crate::api::Session;
use crate::api::data::Topic;
use crate::api::log::LogLine;
use crate::guest::Guest;
use crate::input::{InputError, LiveInputs, open_inputs};

/// Creates the guest of a lambda; the caller can host its kind.
pub type Load<'a> = &'a mut dyn FnMut(
    &ConfiguredLambda,
    &Manifest,
    Session,
    RunMode,
) -> Result<Box<dyn Guest>, Failure>;

/// Limit on the time of a wake, beside fuel and memory.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum RunMode {
    /// No limit: a deadline would make decisions depend on the machine.
    Replay,
    /// A deadline for each wake.
    Live(Duration),
}

/// A lambda before its `init`, over a transport that has delivered nothing yet.
pub struct SessionSetup {
    /// The lambda's topics, in the order of its manifest.
    pub inputs: Vec<Arc<Topic>>,
    /// The lambda's view of inputs, and its triggers and log.
    pub session: Session,
    /// The guest that runs it.
    pub guest: Box<dyn Guest>,
}

impl SessionSetup {
    /// Opens the inputs and loads the lambda. `live` is set where samples arrive while it runs.
    ///
    /// # Errors
    ///
    /// A failure that explains why the lambda cannot start.
    pub fn load(
        transport: &mut dyn Transport,
        lambda: &ConfiguredLambda,
        manifest: &Manifest,
        mode: RunMode,
        live: Option<&LiveInputs>,
        load: Load<'_>,
    ) -> Result<Self, Failure> {
        let inputs = open_inputs(manifest, &lambda.remaps, transport, live).map_err(|error| {
            Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error)
        })?;
        let session = Session::new(inputs.clone(), lambda.config.clone(), &manifest.limits);
        let guest = load(lambda, manifest, session.clone(), mode)?;
        Ok(Self { inputs, session, guest })
    }
}

/// Returns the failure of a run whose lambda faulted in `init`. Prints `log` to standard error: the
/// lines that are in no file, and may explain the fault.
pub fn not_started(lambda: &str, fault: Fault, log: &[LogLine]) -> Failure {
    log.iter().for_each(|line| eprintln!("log: {}", visible(&line.message)));
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
            TransportError::NoSuchTopic { .. } => {
                "correct `topic` in lambda.toml, or pass --remap FROM:=TO".to_owned()
            }
            TransportError::WrongType { found, .. } => {
                format!("write type = \"{found}\" in lambda.toml, or choose another topic")
            }
            TransportError::Encoding { what: "schema encoding", .. } => {
                "put the .msg files of the type, and of those it refers to, into DIR/msg, and \
                 build again"
                    .to_owned()
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
