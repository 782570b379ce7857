//! Tests of checks that fail, without any process.

use gleaner_protocol::ingress::{IngressReport, IngressStatus};
use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::supervision::DesiredLambda;

use super::*;
use crate::inference::InferenceEvent;
use crate::spec::tests::recording;

#[derive(Default)]
struct RestartReasons(Vec<String>);

impl RunObserver for RestartReasons {
    fn restarts(&mut self, _: RestartedPart<'_>, reason: &str, _: Duration, _: u32) {
        self.0.push(reason.to_owned());
    }
    fn lambda(&mut self, _: &LambdaSpec, _: &Report) {}
    fn lambda_gone(&mut self, _: &LambdaSpec) {}
    fn ingress(&mut self, _: &IngressReport) {}
    fn ingress_gone(&mut self) {}
    fn ingress_ended(&mut self, _: &IngressStatus) {}
    fn recorder(&mut self, _: &RecorderReport) {}
    fn inference(&mut self, _: InferenceEvent) {}
    fn playing(&mut self, _: &str) {}
    fn warn(&mut self, _: &str) {}
    fn stderr(&mut self, _: &[u8]) {}
}

/// Returns a deployed lambda whose check ended with this failure, and the reasons of its restarts.
fn checked(is_shortage: bool) -> (SupervisedLambda, Vec<String>) {
    let mut spec = recording("id", None, &[]);
    spec.deployment = Some(Box::new(DesiredLambda {
        id: "id".to_owned(),
        name: "id".to_owned(),
        revision: "a".repeat(64),
        attempt: 1,
        ..DesiredLambda::default()
    }));
    let mut lambda = SupervisedLambda::new(spec);
    let failure = CheckFailure { reason: "no open files are left".to_owned(), is_shortage };
    lambda.enter(LambdaState::Checking(RevisionCheck::ended(Err(failure))));
    let mut observer = RestartReasons::default();
    let (bell, _rings) = std::sync::mpsc::sync_channel(1);
    assert!(!lambda.is_due(&bell, &mut observer));
    (lambda, observer.0)
}

#[test]
fn a_shortage_of_the_vehicle_delays_a_start_and_a_wrong_file_ends_it() {
    let (mut delayed, reasons) = checked(true);
    assert_eq!(reasons, ["id: no open files are left"]);
    let status = delayed.status_report().unwrap();
    assert_eq!((status.phase, status.restarts), (LambdaPhase::Waiting, 1));
    assert_eq!(status.last_end.as_deref(), Some("no open files are left"));
    assert_eq!(delayed.take_quarantine(), None);
    let (mut quarantined, reasons) = checked(false);
    assert!(reasons.is_empty());
    assert_eq!(quarantined.phase(), LambdaPhase::Quarantined);
    assert_eq!(quarantined.take_quarantine().as_deref(), Some("no open files are left"));
}
