//! The ingress of a run, over its restarts.

use std::sync::mpsc::SyncSender;

use gleaner_base::{Exit, Failure, chain};
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::{
    IngressControl, IngressReport, IngressStatus, IngressTopic, JoinedParticipant,
};
use gleaner_protocol::link::LinkError;

use crate::farewell;
use crate::observer::RunObserver;
use crate::output::{ChildId, ChildOutput};
use crate::process::ChildProcess;
use crate::restart_delay::SILENCE;
use crate::service_restarts::ServiceRestarts;
use crate::{RunContext, arguments};

pub(crate) struct IngressProcess {
    pub(crate) child: ChildProcess,
    pub(crate) control: IngressControl,
    /// It is ready when it has joined the network, or opened the drive.
    pub(crate) restarts: ServiceRestarts,
    pub(crate) drive_ended: bool,
    has_ended: bool,
    /// Its participant, until the end of that is announced.
    joined: Option<JoinedParticipant>,
    pub(crate) status: Option<Box<IngressStatus>>,
    /// Last status of each topic that had a reader.
    topics: Vec<IngressTopic>,
    /// Those of earlier ingresses, summed.
    earlier_topics: Vec<IngressTopic>,
    /// Set when the processes that ran before it were connected to it.
    pub(crate) is_joined: bool,
}

impl IngressProcess {
    /// Starts another one after this one has ended; also returns the last status of this one.
    pub(crate) fn start_again(
        &mut self,
        context: &RunContext<'_>,
        largest: u64,
        sender: &SyncSender<ChildOutput>,
    ) -> Result<Option<Box<IngressStatus>>, Failure> {
        let next = Self::start(Some(&*self), context, largest, sender)?;
        Ok(std::mem::replace(self, next).status)
    }

    /// Starts the ingress, after `before` has ended. `largest` is the largest sample of an input,
    /// in bytes.
    pub(crate) fn start(
        before: Option<&Self>,
        context: &RunContext<'_>,
        largest: u64,
        sender: &SyncSender<ChildOutput>,
    ) -> Result<Self, Failure> {
        let (restarts, earlier_topics) = match before {
            None => (ServiceRestarts::first(), Vec::new()),
            Some(before) => (before.restarts.next(), before.topics()),
        };
        let start = restarts.start;
        let (control, ingress_end) = IngressControl::pair().map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot connect to the ingress", &error)
        })?;
        let child = ChildProcess::start(
            &context.parts,
            ("gleaner-ingress", ChildId::Ingress(start), ""),
            arguments::ingress(context.spec, largest, context.offset_ns),
            None,
            Handover { control: Some(ingress_end), ..Handover::default() },
            sender,
        )?;
        Ok(Self {
            child,
            control,
            is_joined: start == 0,
            restarts,
            drive_ended: false,
            has_ended: false,
            joined: None,
            status: None,
            topics: Vec::new(),
            earlier_topics,
        })
    }

    /// Returns the result of a request to it. `None` if it has ended; if the request failed for
    /// another reason, it is killed.
    pub(crate) fn granted<T>(&mut self, requested: Result<T, LinkError>) -> Option<T> {
        match requested {
            Ok(result) => Some(result),
            Err(LinkError::Gone { .. }) => None,
            Err(error) => {
                self.kill(format!("cannot request samples: {}", chain(&error)));
                None
            }
        }
    }

    /// Kills it, so that another one is started, if it does not receive any more. `plays_drive` is
    /// true if it plays a drive: a damaged one ends as another one does.
    pub(crate) fn kill_if_broken(&mut self, plays_drive: bool) {
        if let Some(why) = self.dead().filter(|_| !plays_drive) {
            self.kill(format!("the ingress does not receive: {why}"));
        } else if self.restarts.is_ready && self.restarts.is_silent(SILENCE) {
            let seconds = SILENCE.as_secs();
            self.kill(format!("the ingress has not reported for {seconds} s"));
        }
    }

    /// Kills it for this reason, as it has failed; another one is started.
    pub(crate) fn kill(&mut self, why: String) {
        self.restarts.fails(why);
        self.child.kill();
    }

    /// Kills it for this reason; one with other settings is started.
    pub(crate) fn replace(&mut self, why: String) {
        self.restarts.is_replaced(why);
        self.child.kill();
    }

    /// Makes other nodes forget its participant, now that the process has ended.
    pub(crate) fn leave_network(&mut self) {
        if let Some(joined) = self.joined.take() {
            farewell::send(&joined);
        }
    }

    /// Returns the reason why it receives no further samples; of a drive, why it ended early.
    pub(crate) fn dead(&self) -> Option<&str> {
        self.status.as_ref().and_then(|status| status.health.dead.as_deref())
    }

    pub(crate) fn show(&mut self, report: IngressReport, observer: &mut dyn RunObserver) {
        observer.ingress(&report);
        self.restarts.reports();
        match report {
            IngressReport::Joined(joined) => self.joined = Some(joined),
            IngressReport::Ready => self.restarts.is_ready = true,
            IngressReport::DriveEnded => self.drive_ended = true,
            // Only of `gleaner-ingress topics`.
            IngressReport::Topics { .. } => {}
            IngressReport::Status(status) => {
                self.keep_topics(&status);
                self.status = Some(status);
            }
            IngressReport::Ended(mut status) => {
                self.keep_topics(&status);
                // Its readers have ended before it, and with them their topics.
                status.topics = self.topics();
                observer.ingress_ended(&status);
                self.has_ended = true;
                self.status = Some(status);
            }
        }
    }

    /// Shows the last status of a run that ends without a final one, as the ingress has failed.
    pub(crate) fn show_last(&self, observer: &mut dyn RunObserver) {
        let topics = self.topics();
        if !self.has_ended && !topics.is_empty() {
            let status = self.status.as_deref().cloned().unwrap_or_default();
            observer.ingress_ended(&IngressStatus { topics, readers: 0, ..status });
        }
    }

    fn keep_topics(&mut self, status: &IngressStatus) {
        for topic in &status.topics {
            match find(&mut self.topics, topic) {
                Some(known) => *known = topic.clone(),
                None => self.topics.push(topic.clone()),
            }
        }
    }

    /// Returns the last status of each topic, with the counts of earlier ingresses.
    fn topics(&self) -> Vec<IngressTopic> {
        let mut all = self.earlier_topics.clone();
        for topic in &self.topics {
            match find(&mut all, topic) {
                Some(known) => *known = topic.clone().after(known),
                None => all.push(topic.clone()),
            }
        }
        all
    }
}

fn find<'a>(topics: &'a mut [IngressTopic], topic: &IngressTopic) -> Option<&'a mut IngressTopic> {
    let names = (&topic.topic, &topic.type_name);
    topics.iter_mut().find(|known| (&known.topic, &known.type_name) == names)
}
