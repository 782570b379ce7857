//! Deployments that are refused before they are signed, and those whose answers are lost.

use super::super::fake::problem;
use super::*;

#[test]
fn a_wait_goes_on_after_a_lost_connection_until_its_timeout() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[("car-7", "online", json!({}))]);
    let lost = (503, problem(5, "lost"));
    let running = (200, status(&[on_vehicle(1, "running")]));
    let line = "GET /v1/vehicles/car-7/status";
    user.cloud.answers(line, &[lost.clone(), running]);
    user.done(&DEPLOY);
    user.cloud.answers(line, &[lost]);
    let text = user.fails(5, &[&DEPLOY[..], &["--timeout", "1ms"]].concat());
    assert!(text.contains("goes on by itself: `gleaner fleet` shows it"), "{text}");
}

#[test]
fn what_vehicles_would_refuse_and_a_name_with_two_values_are_not_signed() {
    let user = CloudUser::with_lambda();
    user.vehicles(&[("car-7", "online", json!({}))]);
    user.has_former((6, 2), "key.pem");
    let text = user.fails(2, &DEPLOY);
    assert!(text.contains("release 2 was deployed before"), "{text}");
    assert!(text.contains("gleaner publish DIR --release N"), "{text}");
    for option in ["--label", "--set"] {
        let twice = [option, "town=rome", option, "town=oslo"];
        let text = user.fails(2, &[&DEPLOY[..], &twice].concat());
        assert!(text.contains(&format!("`{option}` has two values for `town`")), "{text}");
    }
    for release in ["0", "9007199254740992"] {
        let mut deploy = user.command(&[&DEPLOY[..], &["--release", release]].concat());
        assert_eq!(programs::output(&mut deploy).status.code(), Some(2));
    }
    let seen = user.cloud.seen();
    assert!(!seen.iter().any(|request| request.line.starts_with("POST")), "{seen:?}");
}
