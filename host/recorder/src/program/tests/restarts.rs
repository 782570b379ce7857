//! Tests of the process while the ingress ends and is started again.

use super::running::*;
use crate::recorder::tests::support::*;
use gleaner_base::Exit;
use gleaner_lambda::TriggerKind::Event;
use gleaner_protocol::link::RecorderStatus;

fn lost(status: &RecorderStatus) -> Option<u64> {
    status.topics.iter().find(|topic| topic.topic == "/a").and_then(|topic| topic.lost)
}

#[test]
fn a_clip_goes_on_while_the_ingress_is_started_again_and_states_what_is_missing() {
    let scratch = TestDir::new();
    let (mut running, network) = Running::start_with_a(&scratch);
    let clock = running.clock;
    let mut link = running.join(&scratch, "first", (10_000, 60_000));
    let sensor = Sensor::start(&network, clock);
    received(&mut running, 300);
    link.wake(&entry(clock.now(), &[Event]), monotonic(clock)).unwrap();
    running.status(|status| status.is_recording);
    running.starter.end_ingress(&network);
    let gone = running.status(|status| status.reception_gaps.count == 1);
    assert_eq!((gone.is_recording, lost(&gone)), (true, None), "unknown is never 0");
    let so_far = gone.topics[0].received;
    running.starter.start_ingress(&network);
    received(&mut running, so_far + 300);
    let again = running.status(|status| lost(status).is_some());
    assert!(lost(&again) > Some(0) && again.reception_gaps.ms > 0, "{again:?}");
    running.starter.control.stop().unwrap();
    let clip = running.clip();
    let (last, ended) = running.ended();
    assert_eq!(ended, Ok(()));
    assert_eq!((last.recording.clips, last.reception_gaps.count), (1, 1));
    assert_eq!(lost(&last), lost(&again));
    // It begins before the recorder did.
    assert_eq!(clip.topics[0].lost, None);
    let stated = "as the ingress had ended";
    assert!(clip.incomplete.iter().any(|why| why.ends_with(stated)), "{:?}", clip.incomplete);
    // Everything but one gap of this size.
    let numbers: Vec<_> = scratch.messages(&clip).into_iter().map(|(_, _, seq, _)| seq).collect();
    let steps: Vec<u32> = numbers.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let gaps: Vec<u64> = steps.iter().filter(|step| **step != 1).map(|it| (*it).into()).collect();
    assert_eq!(gaps, [lost(&again).unwrap() + 1]);
    drop(sensor);
}

#[test]
fn a_recorder_whose_ingress_and_starter_have_ended_completes_its_clips() {
    let scratch = TestDir::new();
    let (mut running, network) = Running::start_with_a(&scratch);
    let mut link = running.join(&scratch, "first", (10_000, 60_000));
    let _sensor = Sensor::start(&network, running.clock);
    received(&mut running, 300);
    running.event(&mut link);
    running.status(|status| status.is_recording);
    running.starter.end_handover();
    running.starter.end_ingress(&network);
    let clip = running.clip();
    assert!(scratch.messages(&clip).len() >= 300);
    let (_, ended) = running.ended();
    let failure = ended.unwrap_err();
    assert_eq!(failure.exit, Exit::Internal, "{failure}");
}
