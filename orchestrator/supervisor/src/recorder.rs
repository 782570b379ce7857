//! The recorder of a run, over its restarts.

use std::os::fd::OwnedFd;
use std::process::ExitStatus;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Limits;
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::AddTopics;
use gleaner_protocol::link::{AddLambda, ControlClient, LinkError, RecorderReport, RecorderStatus};

use crate::grants::{self, RecordedTopics};
use crate::group_end::GroupEnd;
use crate::ingress::{IngressProcess, SILENCE};
use crate::observer::{RestartedPart, RunObserver};
use crate::output::{ChildId, ChildOutput, PIPES};
use crate::process::{ChildProcess, ended};
use crate::process_group::ProcessGroup;
use crate::restart_delay::RestartDelay;
use crate::spec::LambdaSpec;
use crate::supervised::SupervisedLambda;
use crate::{RunContext, arguments};

/// The recorder of a run.
pub(crate) struct RecorderProcess {
    pub(crate) child: ChildProcess,
    pub(crate) control: ControlClient,
    pub(crate) open_pipes: u8,
    /// Set when it accepts lambdas.
    pub(crate) is_ready: bool,
    /// Topics that lambdas record.
    pub(crate) topics: RecordedTopics,
    /// Its last status, with the counts of earlier recorders.
    pub(crate) status: Option<Box<RecorderStatus>>,
    /// The last status of the recorder before it.
    earlier: Option<Box<RecorderStatus>>,
    /// Number of earlier recorders.
    pub(crate) start: u32,
    started: Instant,
    delay: RestartDelay,
    /// Time at which the next recorder is to be started, as this one has ended.
    again_at: Option<Instant>,
    /// The reason why it was requested to end, or killed.
    requested: Option<String>,
    /// Time of its last report.
    heard: Instant,
}

impl RecorderProcess {
    /// Starts the recorder of the lambdas `recorded`, after `before` has ended; returns `None` if
    /// the ingress has ended, which the caller notices.
    pub(crate) fn start<'a>(
        before: Option<&Self>,
        context: &RunContext<'_>,
        recorded: impl Iterator<Item = &'a LambdaSpec> + Clone,
        ingress: &mut IngressProcess,
        sender: &SyncSender<ChildOutput>,
    ) -> Result<Option<Self>, Failure> {
        let start = before.map_or(0, |before| before.start + 1);
        let added = ingress.control.add_reader(&grants::recorder(context.spec, start));
        let Some(ingress) = ingress.granted(added) else { return Ok(None) };
        let (control, recorder_end) = ControlClient::pair().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot connect to the recorder", &error)
        })?;
        let key = context.spec.signing.as_ref().map(|signing| signing.key.try_clone());
        let key = key.transpose().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot pass the key to the recorder", &error)
        })?;
        let connections = Handover {
            control: Some(recorder_end),
            ingress: Some(ingress),
            key: key.map(OwnedFd::from),
            ..Handover::default()
        };
        let child = ChildProcess::start(
            &context.parts,
            ("gleaner-recorder", ChildId::Recorder { start }, ""),
            arguments::recorder(context.spec, recorded.clone(), context.offset_ns),
            None,
            connections,
            sender,
        )?;
        Ok(Some(Self {
            child,
            control,
            open_pipes: PIPES,
            is_ready: false,
            // The samples of the time without a recorder are in the memory of the ingress.
            topics: RecordedTopics::of(recorded, start > 0),
            status: None,
            earlier: before.and_then(|before| before.status.clone()),
            start,
            started: Instant::now(),
            delay: match before {
                Some(before) => before.delay.clone(),
                None if context.spec.spool.is_some() => RestartDelay::of_killed(),
                None => RestartDelay::of_service(),
            },
            again_at: None,
            requested: None,
            heard: Instant::now(),
        }))
    }

    /// Connects the process of a lambda to it; returns the lambda's end. `None` if the recorder or
    /// the ingress has ended, which the caller notices.
    pub(crate) fn connect(
        &mut self,
        lambda: &LambdaSpec,
        most: Limits,
        ingress: &mut IngressProcess,
    ) -> Result<Option<OwnedFd>, Failure> {
        let topics = self.topics.take_new(lambda);
        if !topics.is_empty() {
            let reader = grants::recorder_name(self.start);
            let added = ingress.control.add_topics(&AddTopics { reader, topics });
            if ingress.granted(added).is_none() {
                return Ok(None);
            }
        }
        let add = AddLambda {
            lambda: lambda.folder.clone(),
            remaps: lambda.remaps.clone(),
            most,
            grants: self.topics.ids(lambda),
        };
        match self.control.add(&add) {
            Ok(socket) => Ok(Some(socket)),
            Err(LinkError::Gone { .. }) => Ok(None),
            Err(error) => Err(Failure::because("cannot connect the processes of the run", &error)),
        }
    }

    /// Returns whether it runs, and was not requested to end.
    pub(crate) fn is_running(&self) -> bool {
        self.again_at.is_none() && self.requested.is_none()
    }

    /// Returns whether it has ended, and the end was handled.
    pub(crate) fn has_ended(&self) -> bool {
        self.again_at.is_some()
    }

    /// Returns whether the next one is to be started now.
    pub(crate) fn is_due(&self) -> bool {
        self.again_at.is_some_and(|at| Instant::now() >= at)
    }

    /// Requests it to complete its clips and to end, for this reason; another one is started.
    pub(crate) fn replace(&mut self, why: String) {
        // Fails if it has ended.
        let _ = self.control.stop();
        self.requested.get_or_insert(why);
    }

    /// Kills it, so that another one is started, if it does not report any more.
    fn kill_if_silent(&mut self) {
        if self.is_ready && self.heard.elapsed() > SILENCE {
            let seconds = SILENCE.as_secs();
            self.requested = Some(format!("the recorder has not reported for {seconds} s"));
            self.child.kill();
        }
    }

    /// Handles its end: another one is to be started. Returns the reason, and the delay.
    pub(crate) fn ended(&mut self, status: ExitStatus) -> (String, Duration) {
        let reason = self.requested.take().unwrap_or_else(|| ended("the recorder", status));
        (reason, self.restart(self.started.elapsed()))
    }

    /// Has another one started, after one that `ran` for this time; returns the delay.
    fn restart(&mut self, ran: Duration) -> Duration {
        let delay = self.delay.after(ran);
        self.is_ready = false;
        self.again_at = Some(Instant::now() + delay);
        delay
    }

    pub(crate) fn show(&mut self, report: RecorderReport, observer: &mut dyn RunObserver) {
        let report = match report {
            RecorderReport::Status(status) => RecorderReport::Status(self.with_earlier(status)),
            RecorderReport::Ended(status) => RecorderReport::Ended(self.with_earlier(status)),
            report => report,
        };
        observer.recorder(&report);
        self.heard = Instant::now();
        match report {
            RecorderReport::Ready => self.is_ready = true,
            RecorderReport::Status(status) | RecorderReport::Ended(status) => {
                self.status = Some(status);
            }
            RecorderReport::Clip(_) | RecorderReport::Recovered(_) | RecorderReport::Loss(_) => {}
        }
    }

    fn with_earlier(&self, status: Box<RecorderStatus>) -> Box<RecorderStatus> {
        match &self.earlier {
            Some(earlier) => Box::new(status.after(earlier)),
            None => status,
        }
    }
}

impl ProcessGroup<'_> {
    /// Starts the recorder if it is needed and does not run, and connects the processes that run.
    pub(crate) fn start_recorder(&mut self) -> Result<(), Failure> {
        let spec = self.context.spec;
        let is_recorded = |supervised: &&SupervisedLambda| {
            spec.records && supervised.lambda.manifest.record.is_some()
        };
        let is_due = match &self.recorder {
            None => self.lambdas.iter().any(|it| is_recorded(&it)),
            Some(recorder) => recorder.is_due(),
        };
        if !is_due {
            return Ok(());
        }
        let recorded = self.lambdas.iter().filter(is_recorded).map(|it| &it.lambda);
        let Self { context, ingress, sender, .. } = self;
        let before = self.recorder.as_ref();
        let started = RecorderProcess::start(before, context, recorded, ingress, sender);
        let next = match (started, &mut self.recorder) {
            (Ok(None), _) => return Ok(()),
            (Ok(Some(next)), _) => next,
            (Err(failure), None) => return Err(failure),
            (Err(failure), Some(before)) => {
                let (reason, delay) = (failure.to_string(), before.restart(Duration::ZERO));
                let starts = before.start + 1;
                self.observer.restarts(RestartedPart::Recorder, &reason, delay, starts);
                return Ok(());
            }
        };
        if next.start == 0 {
            next.topics.mixed().for_each(|topic| {
                self.observer.warn(&format!(
                    "lambdas request `{topic}` with different `qos`: clips have the samples of the \
                     first, and are not verified for the others"
                ));
            });
        }
        let recorder = self.recorder.insert(next);
        let running = self.lambdas.iter_mut().filter(|it| it.is_running() && is_recorded(&&**it));
        for supervised in running {
            let lambda = &supervised.lambda;
            let connected = recorder.connect(lambda, self.vehicle.limits, &mut self.ingress)?;
            let Some(socket) = connected else { return Ok(()) };
            let passed = Handover { recorder: Some(socket), ..Handover::default() };
            supervised.pass(&passed, self.observer);
        }
        Ok(())
    }

    /// Notes the end of the recorder: another one is to be started. Returns the end of the group if
    /// all others must end with it.
    pub(crate) fn ended_recorder(&mut self) -> Result<Option<GroupEnd>, Failure> {
        let Some(recorder) = &mut self.recorder else { return Ok(None) };
        if recorder.has_ended() {
            return Ok(None);
        }
        let Some(status) = recorder.child.status()? else {
            recorder.kill_if_silent();
            return Ok(None);
        };
        let has_started = recorder.is_ready || recorder.start > 0;
        // Its ingress may have ended before it was ready.
        let has_lost_ingress = self.ingress.start > 0 || self.ingress.again_at.is_some();
        // On a vehicle, lambdas that record nothing run on without it.
        let is_vehicle = self.context.spec.spool.is_some();
        let is_first = !has_started && !has_lost_ingress && !is_vehicle;
        if is_first || !self.context.spec.drives.is_empty() {
            return Ok(Some(GroupEnd::of("the recorder", status, is_first)));
        }
        self.drain(|group| group.recorder.as_ref().is_some_and(|it| it.open_pipes > 0));
        let Some(recorder) = &mut self.recorder else { return Ok(None) };
        let (reason, delay) = recorder.ended(status);
        let starts = recorder.start + 1;
        self.observer.restarts(RestartedPart::Recorder, &reason, delay, starts);
        self.failures.add(reason, false);
        let recorded = self.lambdas.iter_mut().filter(|it| it.lambda.manifest.record.is_some());
        recorded.for_each(SupervisedLambda::lost_service);
        Ok(None)
    }
}
