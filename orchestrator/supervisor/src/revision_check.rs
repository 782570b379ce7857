//! Compares the files of a deployed lambda with its signed revision before each start, and its
//! Python environment with its wheels.

use std::error::Error;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;

use gleaner_base::{PlainFile, chain, is_shortage};
use gleaner_lambda::BuildDir;
use gleaner_protocol::supervision::DesiredLambda;
use gleaner_trust::{FileDigestError, Payload, Revision, check_files, revision_of_digest};

use crate::output::{ChildOutput, NOTICE};
use crate::wheels::{self, PreparedPython};

/// The environment of a lambda that has wheels, or the reason why it does not start.
pub(crate) type CheckResult = Result<Option<PreparedPython>, CheckFailure>;

/// The reason why a lambda does not start.
pub(crate) struct CheckFailure {
    pub(crate) reason: String,
    /// True if this machine lacks something: then the revision may be as it should be.
    pub(crate) is_shortage: bool,
}

impl CheckFailure {
    pub(crate) fn of(what: &str, error: &(dyn Error + 'static)) -> Self {
        Self { reason: format!("{what}: {}", chain(error)), is_shortage: is_shortage(error) }
    }
}

/// A check in a thread of its own: models of gigabytes take seconds, and other lambdas do not wait.
pub(crate) struct RevisionCheck {
    result: Receiver<CheckResult>,
}

impl RevisionCheck {
    /// Starts the check, which rings `bell` at its end.
    pub(crate) fn start(deployment: &DesiredLambda, bell: SyncSender<ChildOutput>) -> Self {
        let (sender, result) = sync_channel(1);
        let deployment = deployment.clone();
        let thread = thread::Builder::new().name("revision".to_owned());
        // Without a thread, the dropped sender is the result.
        let _ = thread.spawn(move || {
            let _ = sender.send(check(&deployment));
            let _ = bell.try_send(NOTICE);
        });
        Self { result }
    }

    #[cfg(test)]
    pub(crate) fn ended(result: CheckResult) -> Self {
        let (sender, received) = sync_channel(1);
        let _ = sender.send(result);
        Self { result: received }
    }

    pub(crate) fn result(&self) -> Option<CheckResult> {
        match self.result.try_recv() {
            Ok(result) => Some(result),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                let reason = "its files could not be checked: no thread".to_owned();
                Some(Err(CheckFailure { reason, is_shortage: true }))
            }
        }
    }
}

fn check(deployment: &DesiredLambda) -> CheckResult {
    let DesiredLambda { revision, folder, envelope, .. } = deployment;
    let failed = CheckFailure::of;
    let digest = revision.parse().map_err(|error| failed("its revision has no digest", &error))?;
    let envelope = PlainFile::named(envelope, Revision::MAX).and_then(PlainFile::read_whole);
    let envelope = envelope.map_err(|error| failed("its revision cannot be read", &error))?;
    let refused = |error: FileDigestError| failed("its files are refused", &error);
    let revision = revision_of_digest(&envelope, &digest).map_err(|it| refused(it.into()))?;
    check_files(&revision, &BuildDir::of(folder)).map_err(refused)?;
    wheels::prepare(folder).map_err(|error| failed("it has no Python environment", &error))
}
