//! Sets up a lambda's session, over drives or live: its arguments, the rings of its inputs, and the
//! guest that reads them. Also re-exports the writer of its decisions.

mod lambda_args;

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::{Exit, Failure, visible};
use gleaner_lambda::Fault;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::Sources;
use gleaner_messages::transport::Transport;
use gleaner_samples::Feed;

pub use gleaner_lambda::{Output, OutputError, RESULTS};
pub(crate) use lambda_args::take_stdin;
pub use lambda_args::{ConfiguredLambda, LambdaArgs, tighten};

use crate::api::Session;
use crate::api::data::Topic;
use crate::api::log::LogLine;
use crate::guest::Guest;
use crate::input::{InputError, open_fed_inputs, open_inputs};
use crate::isolation::definition_dirs;

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
    pub guest: Box<dyn Guest>,
}

impl SessionSetup {
    /// Opens the inputs in rings that `transport` fills, and loads the lambda.
    pub fn load(
        transport: &mut dyn Transport,
        lambda: &ConfiguredLambda,
        manifest: &Manifest,
        mode: RunMode,
        load: Load<'_>,
    ) -> Result<Self, Failure> {
        let inputs = open_inputs(manifest, &lambda.remaps, transport);
        Self::of_inputs(inputs, lambda, manifest, mode, load)
    }

    /// Attaches the inputs in the memory of the ingress, and loads the lambda.
    pub fn load_fed(
        feed: &mut Feed,
        lambda: &ConfiguredLambda,
        manifest: &Manifest,
        mode: RunMode,
        load: Load<'_>,
    ) -> Result<Self, Failure> {
        let sources = Sources::new(&[lambda.build.path().join("msg")], &definition_dirs());
        let inputs = open_fed_inputs(manifest, &lambda.remaps, feed, &sources);
        Self::of_inputs(inputs, lambda, manifest, mode, load)
    }

    fn of_inputs(
        inputs: Result<Vec<Arc<Topic>>, InputError>,
        lambda: &ConfiguredLambda,
        manifest: &Manifest,
        mode: RunMode,
        load: Load<'_>,
    ) -> Result<Self, Failure> {
        let inputs = inputs.map_err(|error| {
            Failure::because(format!("cannot start lambda `{}`", manifest.lambda.name), &error)
        })?;
        let session = Session::new(inputs.clone(), lambda.config.clone(), &manifest.limits)
            .with_models(lambda.models.clone());
        if let RunMode::Live(_) = mode {
            lambda.models.limit(Some(manifest.limits.model_time));
        }
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
