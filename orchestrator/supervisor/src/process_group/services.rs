//! The ingress and the recorder of a group, which all lambdas share: their ends, and those after
//! them, to which the processes that run are connected.

use std::collections::HashSet;

use gleaner_base::Failure;
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::AddTopics;

use super::{GroupEnd, ProcessGroup};
use crate::grants;
use crate::observer::RestartedPart;
use crate::recorder::RecorderProcess;
use crate::supervised::SupervisedLambda;

impl ProcessGroup<'_> {
    /// Starts the ingress again if it has ended, or receives nothing more; returns the end of the
    /// group if all others must end with it.
    pub(super) fn ended_ingress(&mut self) -> Result<Option<GroupEnd>, Failure> {
        let Self { ingress, context, observer, .. } = self;
        if ingress.restarts.has_ended() {
            if ingress.restarts.is_due() {
                match ingress.start_again(context, self.largest, &self.sender) {
                    Ok(last) => self.counts.add(last, None),
                    Err(failure) => {
                        let (reason, delay) = ingress.restarts.not_started(&failure);
                        let starts = ingress.restarts.start + 1;
                        observer.restarts(RestartedPart::Ingress, &reason, delay, starts);
                    }
                }
            }
            return Ok(None);
        }
        let plays_drive = !context.spec.drives.is_empty();
        let Some(status) = ingress.child.status()? else {
            ingress.kill_if_broken(plays_drive);
            return Ok(None);
        };
        let is_ready = ingress.restarts.is_ready;
        let is_first = ingress.restarts.start == 0 && !is_ready && !context.spec.is_vehicle();
        if plays_drive || is_first {
            return Ok(Some(GroupEnd::of("the ingress", status, !is_ready)));
        }
        self.drain(|group| group.ingress.restarts.open_pipes > 0);
        let Self { ingress, observer, .. } = self;
        ingress.leave_network();
        let reason = ingress.restarts.reason("the ingress", status);
        observer.ingress_gone();
        let (delay, starts) = (ingress.restarts.ended(status), ingress.restarts.start + 1);
        observer.restarts(RestartedPart::Ingress, &reason, delay, starts);
        self.failures.add(reason, false);
        self.lambdas.iter_mut().for_each(SupervisedLambda::lost_service);
        Ok(None)
    }

    /// Connects the processes that ran before the current ingress to it. Does nothing more if it
    /// has ended, which the caller notices.
    pub(super) fn join_ingress(&mut self) {
        let Self { context, lambdas, observer, ingress, recorder, .. } = self;
        if std::mem::replace(&mut ingress.is_joined, true) {
            return;
        }
        if let Some(recorder) = recorder.as_mut().filter(|it| it.restarts.is_running()) {
            let start = recorder.restarts.start;
            let reader = grants::recorder(context.spec, start);
            let added = ingress.control.add_reader(&grants::again(reader, true));
            let Some(socket) = ingress.granted(added) else { return };
            let mut again = HashSet::new();
            for supervised in lambdas.iter() {
                let topics = recorder.topics.take_again(&supervised.lambda, &mut again);
                if !topics.is_empty() {
                    let reader = grants::recorder_name(start);
                    let add = AddTopics { reader, topics };
                    let added = ingress.control.add_topics(&add);
                    if ingress.granted(added).is_none() {
                        return;
                    }
                }
            }
            let passed = Handover { ingress: Some(socket), ..Handover::default() };
            if let Some(warning) = recorder.child().and_then(|child| child.pass(&passed)) {
                observer.warn(&warning);
            }
        }
        for supervised in lambdas.iter() {
            let (lambda, Some(number)) = (&supervised.lambda, supervised.process_number()) else {
                continue;
            };
            let is_recorded = recorder.is_some() && lambda.manifest.record.is_some();
            let reader = grants::lambda(lambda, context.spec, is_recorded, number);
            let added = ingress.control.add_reader(&grants::again(reader, recorder.is_some()));
            let Some(socket) = ingress.granted(added) else { return };
            let passed = Handover { ingress: Some(socket), ..Handover::default() };
            supervised.pass(&passed, *observer);
        }
    }

    /// Starts the recorder if it is needed and does not run, and connects the processes that run.
    pub(super) fn start_recorder(&mut self) -> Result<(), Failure> {
        let spec = self.context.spec;
        let is_recorded = |supervised: &&SupervisedLambda| {
            spec.records && supervised.lambda.manifest.record.is_some()
        };
        let is_due = match &self.recorder {
            None => self.lambdas.iter().any(|it| is_recorded(&it)),
            Some(recorder) => recorder.restarts.is_due(),
        };
        if !is_due {
            return Ok(());
        }
        let recorded = self.lambdas.iter().filter(is_recorded).map(|it| &it.lambda);
        let Self { context, ingress, sender, .. } = self;
        let before = self.recorder.as_ref();
        let started = RecorderProcess::start(before, context, recorded, ingress, sender);
        let Some((mut next, failure)) = started else { return Ok(()) };
        let is_first = next.restarts.start == 0;
        match failure {
            // On a vehicle, lambdas run on without it.
            Some(failure) if is_first && !spec.is_vehicle() => return Err(failure),
            Some(failure) => {
                let (reason, delay) = next.restarts.not_started(&failure);
                let starts = next.restarts.start + 1;
                self.observer.restarts(RestartedPart::Recorder, &reason, delay, starts);
                self.recorder = Some(next);
                return Ok(());
            }
            None => {}
        }
        if is_first {
            next.topics.mixed.iter().for_each(|topic| {
                self.observer.warn(&format!(
                    "lambdas request `{topic}` with different `qos`: clips have the samples of the \
                     first, and are not verified for the others"
                ));
            });
        }
        let recorder = self.recorder.insert(next);
        for supervised in self.lambdas.iter().filter(|it| it.is_running() && is_recorded(it)) {
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
    pub(super) fn ended_recorder(&mut self) -> Result<Option<GroupEnd>, Failure> {
        let Some(recorder) = &mut self.recorder else { return Ok(None) };
        if recorder.restarts.has_ended() {
            return Ok(None);
        }
        let Some(child) = recorder.child() else { return Ok(None) };
        let Some(status) = child.status()? else {
            recorder.kill_if_silent();
            return Ok(None);
        };
        let has_started = recorder.restarts.is_ready || recorder.restarts.start > 0;
        // Its ingress may have ended before it was ready.
        let has_lost_ingress = self.ingress.restarts.start > 0 || self.ingress.restarts.has_ended();
        let is_first = !has_started && !has_lost_ingress && !self.context.spec.is_vehicle();
        if is_first || !self.context.spec.drives.is_empty() {
            return Ok(Some(GroupEnd::of("the recorder", status, is_first)));
        }
        self.drain(|group| group.recorder.as_ref().is_some_and(|it| it.restarts.open_pipes > 0));
        let Some(recorder) = &mut self.recorder else { return Ok(None) };
        let reason = recorder.restarts.reason("the recorder", status);
        let (delay, starts) = (recorder.restarts.ended(status), recorder.restarts.start + 1);
        self.observer.restarts(RestartedPart::Recorder, &reason, delay, starts);
        self.failures.add(reason, false);
        Ok(None)
    }
}
