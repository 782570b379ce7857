//! The events of a run, for those who watch it.

use std::time::Duration;

use gleaner_protocol::Report;
use gleaner_protocol::ingress::{IngressReport, IngressStatus};
use gleaner_protocol::link::RecorderReport;

use crate::inference::InferenceEvent;
use crate::spec::LambdaSpec;

#[derive(Clone, Copy, Debug)]
pub enum RestartedPart<'a> {
    All,
    Ingress,
    Recorder,
    Lambda(&'a LambdaSpec),
}

/// A receiver of the events of a run, in the thread that supervises it. What takes long there
/// delays restarts.
pub trait RunObserver {
    /// A report of the process of a lambda.
    fn lambda(&mut self, lambda: &LambdaSpec, report: &Report);
    fn lambda_gone(&mut self, lambda: &LambdaSpec);
    /// A deployed lambda is not started again, for this reason.
    fn quarantined(&mut self, _lambda: &LambdaSpec, _reason: &str) {}
    fn ingress(&mut self, report: &IngressReport);
    /// The ingress has ended, and is started again.
    fn ingress_gone(&mut self);
    /// The final status of the ingress, with the topics of all ingresses of the run.
    fn ingress_ended(&mut self, status: &IngressStatus);
    fn recorder(&mut self, report: &RecorderReport);
    fn inference(&mut self, event: InferenceEvent);
    /// A drive begins: its files, as text.
    fn playing(&mut self, files: &str);
    /// A part of the run failed for a reason, and is started again after a delay; `restarts` counts
    /// these.
    fn restarts(&mut self, part: RestartedPart<'_>, reason: &str, delay: Duration, restarts: u32);
    /// Something else went wrong.
    fn warn(&mut self, text: &str);
    /// A piece of a process's standard error, without control characters.
    fn stderr(&mut self, piece: &[u8]);
}
