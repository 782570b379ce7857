//! Tests of a lambda's connection to the next recorder.

use std::os::unix::net::UnixStream;
use std::thread;

use super::tests::{TIMEOUT, connected, entry, header};
use super::*;
use crate::counts::LinkLosses;

#[test]
fn a_recorder_that_gives_way_has_all_wakes_or_leaves_them_to_the_next() {
    let (mut lambda, mut link, mut replies) = connected();
    replies.ready();
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    let sent = (0..10).map(|at| lambda.wake(&entry(at, Some("here")), at));
    sent.collect::<Result<(), LinkError>>().unwrap();
    replies.accept_no_more();
    let ended = lambda.wake(&entry(10, Some("here")), 10).unwrap_err();
    assert!(matches!(ended, LinkError::Gone { .. }), "{ended}");
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    for expected in 0..10 {
        let received = link.receive().unwrap();
        let Some(LambdaMessage::Wake { entry, .. }) = received else { panic!() };
        assert_eq!(entry.at_ns, expected);
    }
    assert!(matches!(link.receive(), Ok(None)), "the end, without the lambda's doing");
    let (lambda_end, recorder_end) = UnixStream::pair().unwrap();
    let (mut link, mut replies) = LambdaLink::new(recorder_end.into()).unwrap();
    lambda.rejoin(lambda_end.into(), &header("hello")).unwrap();
    replies.ready();
    while lambda.poll().unwrap().is_empty() {
        thread::yield_now();
    }
    let losses = LinkLosses { recorders_ended: 1, ..Default::default() };
    assert_eq!(lambda.bye(TIMEOUT), losses);
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    let received = link.receive().unwrap();
    assert!(
        matches!(&received, Some(LambdaMessage::Wake { entry, missing: 0, .. }) if entry.at_ns == 10),
        "{received:?}"
    );
}

#[test]
fn wakes_wait_for_the_next_recorder() {
    let (mut lambda, link, mut replies) = connected();
    replies.ready();
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    drop((link, replies));
    let ended = lambda.wake(&entry(0, Some("here")), 0).unwrap_err();
    assert!(matches!(ended, LinkError::Gone { .. }), "{ended}");
    lambda.drop_queued();
    lambda.wake(&entry(1, Some("here")), 0).unwrap();
    lambda.wake(&entry(2, Some("here")), 0).unwrap();
    assert!(lambda.poll().unwrap().is_empty() && !lambda.is_joined());
    let (lambda_end, recorder_end) = UnixStream::pair().unwrap();
    let (mut link, mut replies) = LambdaLink::new(recorder_end.into()).unwrap();
    lambda.rejoin(lambda_end.into(), &header("hello")).unwrap();
    assert!(lambda.poll().unwrap().is_empty() && !lambda.is_joined());
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    replies.ready();
    while lambda.poll().unwrap().is_empty() {
        thread::yield_now();
    }
    assert!(lambda.is_joined());
    let losses = LinkLosses { recorders_ended: 1, triggers_lost: 1, ..Default::default() };
    assert_eq!(lambda.bye(TIMEOUT), losses);
    for expected in [(1, 1), (2, 0)] {
        let received = link.receive().unwrap();
        let Some(LambdaMessage::Wake { entry, missing, .. }) = received else { panic!() };
        assert_eq!((entry.at_ns, missing), expected);
    }
}
