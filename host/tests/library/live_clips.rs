//! Clips of a live run are verified: lambda and recorder received the same samples with the same
//! stamps.

use gleaner_base::Exit;
use gleaner_lambda::Clip;
use gleaner_protocol::Verified;

use crate::recorded_run::{RecordedRun, SLOW, TRIGGER};

/// Starts a run whose recorder has all topics, with `n` wakes and a trigger.
fn recorded(n: i64) -> RecordedRun {
    let mut running = RecordedRun::start();
    running.record_others();
    running.burst(n);
    running
}

fn verified(running: &mut RecordedRun) -> Verified {
    let clip = running.clip();
    running.verify(clip).unwrap()
}

#[test]
fn a_live_clip_is_verified_with_all_of_its_wakes() {
    let mut running = recorded(50);
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers), (0, 1), "{verified:?}");
    assert_eq!(verified.wakes, 51);
    running.end();
}

#[test]
fn a_wake_at_its_deadline_is_not_repeated_and_the_lambda_starts_again_after_it() {
    let mut running = recorded(5);
    running.wake(SLOW);
    running.burst(5);
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers, verified.wakes), (0, 2, 13), "{verified:?}");
    assert_eq!(verified.notes.len(), 1, "{verified:?}");
    assert!(verified.notes[0].starts_with("1 wake that exceeded the deadline"), "{verified:?}");
    running.end();
}

#[test]
fn samples_that_are_larger_than_the_lambda_accepts_do_not_disturb() {
    let mut running = RecordedRun::start();
    running.record_others();
    for _ in 0..5 {
        running.publish("/others", 1, 100);
        running.burst(3);
        running.publish("/others", 2, 8);
    }
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers), (0, 5), "{verified:?}");
    running.end();
}

#[test]
fn a_lambda_that_is_woken_by_a_sample_from_before_its_start_is_verified() {
    is_verified_after(0, 3);
}

#[test]
fn samples_of_a_clip_from_before_the_start_of_the_lambda_are_not_shown_to_it() {
    is_verified_after(7, 0);
}

/// Asserts that the clip of a lambda is verified, which is started after these samples; see
/// [`RecordedRun::start_after`].
fn is_verified_after(earlier: i64, early: i64) {
    let mut running = RecordedRun::start_after(earlier, early);
    running.record_others();
    running.burst(5);
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers), (0, 1), "{verified:?}");
    running.end();
}

#[test]
fn a_clip_over_a_restart_of_the_ingress_is_verified_if_nothing_was_lost() {
    let mut running = recorded(5);
    running.restart_ingress(0, 3);
    running.burst(3);
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers, verified.wakes), (0, 2, 10), "{verified:?}");
    running.end();
}

#[test]
fn samples_that_a_restarted_ingress_receives_again_are_repeated_in_the_verification() {
    let mut running = recorded(5);
    running.restart_ingress(0, 0);
    // A writer with durability `transient_local` sends its last ones again.
    running.send_last_again();
    running.publish("/others", 5, 8);
    running.wake(TRIGGER);
    running.burst(3);
    let verified = verified(&mut running);
    assert_eq!((verified.uncovered, verified.triggers, verified.wakes), (0, 3, 11), "{verified:?}");
    running.end();
}

#[test]
fn a_clip_states_what_a_restart_of_the_ingress_has_lost_and_lambda_and_recorder_agree() {
    let mut running = recorded(5);
    running.restart_ingress(7, 0);
    running.burst(3);
    let clip: Clip = running.next_clip();
    let stated = "as the ingress had ended";
    assert!(clip.incomplete.iter().any(|why| why.ends_with(stated)), "{clip:?}");
    // Both received the same.
    let verified = running.verify(running.file_of(&clip)).unwrap();
    assert_eq!((verified.uncovered, verified.triggers, verified.wakes), (0, 2, 10), "{verified:?}");
    running.end();
}

#[test]
fn wakes_before_the_recorder_received_a_topic_are_not_compared_and_leave_later_ones_open() {
    let mut running = RecordedRun::start();
    running.burst(7);
    running.record_others();
    running.burst(7);
    let clip = running.clip();
    // The sum of the second trigger includes the first wakes.
    let failure = running.verify(clip).unwrap_err();
    assert_eq!(failure.exit, Exit::Usage, "{failure}");
    assert!(failure.message.contains("does not settle wake 16"), "{failure}");
    assert!(failure.to_string().contains("samples from before the clip"), "{failure}");
    running.end();
}
