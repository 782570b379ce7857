//! Samples whose layout writers announce after the lambda has chosen its definitions.

use crate::live::Running;

/// Hash of the layout "int64 value", by rosbags.
pub const LAYOUT: &str = "RIHS01_376752aeb9e256c4e2313368a5a32645d62041d37777621433ea5e52e280b5ea";

#[test]
fn samples_of_an_announced_layout_wait_until_it_is_known_to_be_that_of_the_definitions() {
    let other = LAYOUT.replace('0', "1");
    let mut running = Running::start(None);
    running.publish(1);
    assert_eq!(running.decided(), 1.0);
    // The ingress does not know the layout yet.
    running.publish_in(1, 2);
    running.live(|live| live.skipped == 1);
    *running.announced.lock().unwrap() = Some(LAYOUT.to_owned());
    running.publish_in(1, 3);
    assert_eq!(running.decided(), 3.0);
    running.publish_in(1, 4);
    assert_eq!(running.decided(), 4.0);
    // Another ingress may receive another layout.
    *running.announced.lock().unwrap() = None;
    running.end_ingress();
    running.interrupted(1);
    let socket = running.start_ingress();
    running.hand_over(socket);
    running.live(|live| live.topics[0].writers == Some(1));
    *running.announced.lock().unwrap() = Some(other.clone());
    running.publish_in(1, 5);
    let failure = running.ended().unwrap_err().to_string();
    assert!(failure.contains("input `numbers` can no longer be read"), "{failure}");
    assert!(failure.contains(LAYOUT) && failure.contains(&other), "{failure}");
}
