//! The recorder of a run, over its restarts.

use std::ffi::OsString;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Limits;
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::AddTopics;
use gleaner_protocol::link::{AddLambda, ControlClient, LinkError, RecorderReport, RecorderStatus};

use crate::grants::{self, RecordedTopics};
use crate::ingress::IngressProcess;
use crate::observer::RunObserver;
use crate::output::{ChildId, ChildOutput};
use crate::process::ChildProcess;
use crate::restart_delay::SILENCE;
use crate::service_restarts::ServiceRestarts;
use crate::spec::LambdaSpec;
use crate::{RunContext, arguments};

/// Time for the recorder to become ready: on a busy machine, with a large preroll to allocate. The
/// lambdas wait as long for it at their start.
const READY: Duration = Duration::from_secs(120);

pub(crate) struct RecorderProcess {
    /// `None` if it could not be started.
    process: Option<(ChildProcess, ControlClient)>,
    /// It is ready when it accepts lambdas.
    pub(crate) restarts: ServiceRestarts,
    pub(crate) topics: RecordedTopics,
    /// Its last status, with the counts of earlier recorders.
    pub(crate) status: Option<Box<RecorderStatus>>,
    /// The last status of the recorder before it.
    earlier: Option<Box<RecorderStatus>>,
}

impl RecorderProcess {
    /// Starts the recorder of the lambdas `recorded`, after `before` has ended; also returns the
    /// failure if it could not be started. `None` if the ingress has ended, which the caller
    /// notices.
    pub(crate) fn start<'a>(
        before: Option<&Self>,
        context: &RunContext<'_>,
        recorded: impl Iterator<Item = &'a LambdaSpec> + Clone,
        ingress: &mut IngressProcess,
        sender: &SyncSender<ChildOutput>,
    ) -> Option<(Self, Option<Failure>)> {
        let mut restarts = before.map_or_else(ServiceRestarts::first, |it| it.restarts.next());
        let start = restarts.start;
        let added = ingress.control.add_reader(&grants::recorder(context.spec, start));
        let ingress = ingress.granted(added)?;
        let line = arguments::recorder(context.spec, recorded.clone(), context.offset_ns);
        let started = start_process(context, start, line, ingress, sender);
        let (process, failure) = match started {
            Ok(process) => (Some(process), None),
            Err(failure) => {
                restarts.open_pipes = 0;
                (None, Some(failure))
            }
        };
        let recorder = Self {
            process,
            restarts,
            // The samples of the time without a recorder are in the memory of the ingress.
            topics: RecordedTopics::of(recorded, start > 0),
            status: None,
            earlier: before.and_then(Self::last_status),
        };
        Some((recorder, failure))
    }

    /// Connects the process of a lambda to it; returns the lambda's end. If it does not run, that
    /// is a closed connection: the lambda decides without a recorder until it is connected to the
    /// next one. `None` if the ingress has ended, which the caller notices.
    pub(crate) fn connect(
        &mut self,
        lambda: &LambdaSpec,
        most: Limits,
        ingress: &mut IngressProcess,
    ) -> Result<Option<OwnedFd>, Failure> {
        let Some((_, control)) = self.process.as_mut().filter(|_| self.restarts.is_running())
        else {
            return closed_connection().map(Some);
        };
        let topics = self.topics.take_new(lambda);
        if !topics.is_empty() {
            let reader = grants::recorder_name(self.restarts.start);
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
        match control.add(&add) {
            Ok(socket) => Ok(Some(socket)),
            Err(LinkError::Gone { .. }) => closed_connection().map(Some),
            Err(error) => Err(Failure::because("cannot connect the processes of the run", &error)),
        }
    }

    pub(crate) fn child(&mut self) -> Option<&mut ChildProcess> {
        self.process.as_mut().map(|(child, _)| child)
    }

    /// Returns its last status, or that of a recorder before it.
    pub(crate) fn last_status(&self) -> Option<Box<RecorderStatus>> {
        self.status.clone().or_else(|| self.earlier.clone())
    }

    /// Requests it to complete its clips and to end.
    pub(crate) fn stop(&mut self) {
        if let Some((_, control)) = &mut self.process {
            // Fails if it has ended.
            let _ = control.stop();
        }
    }

    /// Requests it to end for this reason; another one is started, which the lambdas join.
    pub(crate) fn replace(&mut self, why: String) {
        if let Some((_, control)) = &mut self.process {
            // Fails if it has ended.
            let _ = control.give_way();
        }
        self.restarts.is_replaced(why);
    }

    /// Kills it, so that another one is started, if it does not become ready, or does not report
    /// any more.
    pub(crate) fn kill_if_silent(&mut self) {
        let (most, what) = match self.restarts.is_ready {
            true => (SILENCE, "has not reported for"),
            false => (READY, "was not ready after"),
        };
        if self.restarts.is_silent(most) {
            self.restarts.fails(format!("the recorder {what} {} s", most.as_secs()));
            if let Some(child) = self.child() {
                child.kill();
            }
        }
    }

    pub(crate) fn show(&mut self, report: RecorderReport, observer: &mut dyn RunObserver) {
        let report = match report {
            RecorderReport::Status(status) => RecorderReport::Status(self.with_earlier(status)),
            RecorderReport::Ended(status) => RecorderReport::Ended(self.with_earlier(status)),
            report => report,
        };
        observer.recorder(&report);
        self.restarts.reports();
        match report {
            RecorderReport::Ready => self.restarts.is_ready = true,
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

fn start_process(
    context: &RunContext<'_>,
    start: u32,
    line: Vec<OsString>,
    ingress: OwnedFd,
    sender: &SyncSender<ChildOutput>,
) -> Result<(ChildProcess, ControlClient), Failure> {
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
    let name = ("gleaner-recorder", ChildId::Recorder(start), "");
    let child = ChildProcess::start(&context.parts, name, line, None, connections, sender)?;
    Ok((child, control))
}

/// Returns a lambda's end of a connection to a recorder that has ended.
fn closed_connection() -> Result<OwnedFd, Failure> {
    let pair = UnixStream::pair();
    pair.map(|(lambda_end, _)| lambda_end.into())
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot create a socket", &error))
}
