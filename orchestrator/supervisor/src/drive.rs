//! A drive that the ingress plays: its start, and the end of the run after it.

use std::time::{Duration, Instant};

use gleaner_base::visible;

use crate::ingress::IngressProcess;
use crate::observer::RunObserver;
use crate::spec::RunSpec;
use crate::supervised::SupervisedLambda;

/// Time after the end of a drive without a wake, after which the run ends even if a lambda has not
/// handled all samples: longer than the longest wake.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(30);

pub(crate) struct DriveProgress {
    files: String,
    has_begun: bool,
    /// Time of the last wake after the end of the drive, and the number of wakes then.
    last_wake: Option<(Instant, u64)>,
}

impl DriveProgress {
    /// Returns the progress of the drive of a run; `None` without one.
    pub(crate) fn of(spec: &RunSpec) -> Option<Self> {
        let names = spec.drives.iter().map(|file| visible(&file.to_string_lossy()));
        let files = names.collect::<Vec<_>>().join(", ");
        (!files.is_empty()).then_some(Self { files, has_begun: false, last_wake: None })
    }

    /// Starts the drive, once: all lambdas must be ready.
    pub(crate) fn begin(&mut self, ingress: &mut IngressProcess, observer: &mut dyn RunObserver) {
        if !self.has_begun {
            // An error means that the ingress has ended, which the caller notices.
            self.has_begun = ingress.control.begin().is_ok();
            observer.playing(&self.files);
        }
    }

    /// Returns whether the lambdas have handled all samples of the drive, which has ended.
    pub(crate) fn is_over(
        &mut self,
        lambdas: &[SupervisedLambda],
        observer: &mut dyn RunObserver,
    ) -> bool {
        if lambdas.iter().all(SupervisedLambda::has_handled_drive) {
            return true;
        }
        let wakes = lambdas.iter().map(SupervisedLambda::wakes).sum();
        let (since, before) = self.last_wake.get_or_insert((Instant::now(), wakes));
        if wakes != *before {
            (*since, *before) = (Instant::now(), wakes);
        }
        let is_late = since.elapsed() >= DRAIN_TIMEOUT;
        if is_late {
            observer.warn("the drive is over, and a lambda did not handle its last samples");
        }
        is_late
    }
}
