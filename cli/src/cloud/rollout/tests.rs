use gleaner_protocol::supervision::SupervisorStatus;
use serde_json::{Value, json};

use super::*;

fn rollout(goal: Goal) -> Rollout {
    let (id, envelope) = ("brake".to_owned(), Some("e2".to_owned()));
    Rollout { id, selector: Selector::new(), envelope, goal, plan: FleetPlan::default() }
}

fn status(deployments: &[Value]) -> VehicleStatus {
    let mut all = Vec::new();
    for fields in deployments {
        let mut deployment = json!({
            "id": "brake", "release": 2, "envelope": "e2", "attempt": 5, "lambda": "brake",
            "revision": { "digest": "new", "version": "0.2.0", "release": 2 },
            "fallback": { "digest": "old", "version": "0.1.0", "release": 1 },
            "grants": { "topics": [], "models": [], "record": false },
            "is_wanted": true, "runs_fallback": false, "is_proven": true,
        });
        let fields = fields.as_object().unwrap().clone();
        deployment.as_object_mut().unwrap().extend(fields);
        all.push(deployment);
    }
    let status = json!({
        "vehicle": "car-7", "key": "k", "labels": {}, "generation": 1, "capacity": [],
        "orchestrator": { "version": "1", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 },
        "deployments": all,
    });
    serde_json::from_value(status).unwrap()
}

fn lambda(phase: &str, attempt: u64) -> Value {
    json!({
        "id": "brake", "name": "brake", "revision": "new", "attempt": attempt, "phase": phase,
        "phase_s": 1.0, "restarts": 0, "last_end": "exit code 1", "layers": [],
    })
}

fn judge(goal: Goal, fields: Value) -> Standing {
    rollout(goal).judge(goal, &status(&[fields]), &[])
}

const NEW: Goal = Goal::Revision { release: 2 };

#[test]
fn a_vehicle_is_done_once_it_runs_the_new_revision() {
    let done = Standing::Done("runs 0.2.0".to_owned());
    assert_eq!(judge(NEW, json!({ "status": lambda("running", 5) })), done);
    for (fields, reason) in [
        (json!({}), "has not confirmed the start yet"),
        (json!({ "status": lambda("running", 4) }), "has not confirmed the start yet"),
        (json!({ "status": lambda("starting", 5) }), "its lambda is starting"),
        (
            json!({ "envelope": "other", "status": lambda("running", 5) }),
            "has another deployment, with release 2",
        ),
    ] {
        assert_eq!(judge(NEW, fields), Standing::Pending(reason.to_owned()));
    }
    let absent = rollout(NEW).judge(NEW, &status(&[]), &[]);
    assert_eq!(absent, Standing::Pending("does not have the deployment yet".to_owned()));
}

#[test]
fn a_vehicle_that_will_not_run_the_new_revision_has_failed_with_the_reason() {
    let fallback =
        json!({ "runs_fallback": true, "failed": "it faults", "status": lambda("running", 6) });
    let mut running = lambda("running", 5);
    running["recent"] = json!({ "wakes": 20, "faults": 20, "backed_off": 0 });
    assert!(judge(NEW, json!({ "status": running })).is_done(), "after its probation");
    let faulty = json!({ "is_proven": false, "fallback": null, "status": running });
    let reason = "runs 0.2.0, but 20 of its last 20 wakes faulted";
    for (fields, exit, reason) in [
        (faulty, Exit::LambdaFaulted, reason),
        (json!({ "refused": "no key" }), Exit::Denied, "refused: no key"),
        (fallback, Exit::LambdaFaulted, "runs its fallback 0.1.0: it faults"),
        (
            json!({ "release": 3, "envelope": "other" }),
            Exit::Differs,
            "has another deployment, with release 3",
        ),
        (
            json!({ "status": lambda("quarantined", 5) }),
            Exit::LambdaFaulted,
            "does not run, and is not restarted: exit code 1",
        ),
    ] {
        assert_eq!(judge(NEW, fields), Standing::Failed(exit, reason.to_owned()));
    }
    let problem = |deployment: &str, envelope: &str, is_pending| WantedProblem {
        deployment: deployment.to_owned(),
        envelope: envelope.to_owned(),
        title: "no key".to_owned(),
        is_pending,
        ..WantedProblem::default()
    };
    let judge = |problem| rollout(NEW).judge(NEW, &status(&[]), &[problem]);
    let refused = judge(problem("brake", "e2", false));
    assert_eq!(refused, Standing::Failed(Exit::Denied, "no key".to_owned()));
    assert_eq!(judge(problem("brake", "e2", true)), Standing::Pending("no key".to_owned()));
    // Of another deployment, and of an earlier one of this id.
    for (id, envelope) in [("other", "e2"), ("brake", "e1")] {
        let absent = Standing::Pending("does not have the deployment yet".to_owned());
        assert_eq!(judge(problem(id, envelope, false)), absent);
    }
    // Another deployment with the same number, and the refusal of this one.
    let other = status(&[json!({ "envelope": "e1", "status": lambda("running", 5) })]);
    let judged = rollout(NEW).judge(NEW, &other, &[problem("brake", "e2", false)]);
    assert_eq!(judged, refused);
}

#[test]
fn a_rollback_waits_for_the_fallback_and_a_start_for_either() {
    let fallback = || json!({ "runs_fallback": true, "status": lambda("running", 6) });
    let own = || json!({ "status": lambda("running", 6) });
    assert!(judge(Goal::Fallback, fallback()).is_done());
    assert!(judge(Goal::Running, fallback()).is_done());
    assert!(judge(Goal::Running, own()).is_done());
    assert_eq!(judge(Goal::Fallback, own()), Standing::Pending("runs its revision".to_owned()));
    let none = judge(Goal::Fallback, json!({ "fallback": null }));
    let kept = "keeps release 2, which has no fallback".to_owned();
    assert_eq!(none, Standing::Failed(Exit::Differs, kept));
    let stopped = judge(Goal::Running, json!({ "is_wanted": false }));
    assert_eq!(stopped, Standing::Pending("is stopped".to_owned()));
}

#[test]
fn a_stop_and_a_removal_wait_for_the_end_of_the_lambda() {
    let supervised = |status: VehicleStatus, lambdas: Value| {
        let lambdas = serde_json::from_value(lambdas).unwrap();
        VehicleStatus { supervisor: Some(SupervisorStatus { lambdas, ..supervisor() }), ..status }
    };
    let stopped = || status(&[json!({ "is_wanted": false })]);
    let judge = |goal, status: VehicleStatus| rollout(goal).judge(goal, &status, &[]);
    let ends = json!([lambda("stopping", 5)]);
    for (goal, applied) in [(Goal::Stopped, stopped()), (Goal::Removed, status(&[]))] {
        assert!(judge(goal, supervised(applied.clone(), json!([]))).is_done());
        let still = judge(goal, supervised(applied.clone(), ends.clone()));
        assert_eq!(still, Standing::Pending("its lambda is still stopping".to_owned()));
        let unknown = judge(goal, applied);
        assert_eq!(unknown, Standing::Pending("its supervisor does not report".to_owned()));
    }
    let judged = judge(Goal::Removed, supervised(stopped(), json!([])));
    assert_eq!(judged, Standing::Pending("has not applied the change yet".to_owned()));
}

fn supervisor() -> SupervisorStatus {
    let status = json!({
        "generation": 1, "up_s": 1.0, "lambdas": [], "clips": 0, "events_lost": 0,
        "ingress": { "is_ready": true, "restarts": 0 },
    });
    serde_json::from_value(status).unwrap()
}

#[test]
fn the_error_has_the_reason_of_each_vehicle_and_the_worst_exit_code() {
    let pending = || Standing::Pending("offline".to_owned());
    let failed = |exit| Standing::Failed(exit, "bad".to_owned());
    let exit = |others: &[Standing]| {
        let all = others.iter().enumerate().map(|(n, it)| (format!("car-{n}"), it.clone()));
        rollout(NEW).failure(&all.collect(), "1 of 3 vehicles")
    };
    let failure = exit(&[pending(), failed(Exit::LambdaFaulted)]);
    assert_eq!(failure.exit, Exit::LambdaFaulted);
    assert_eq!(failure.message, "`brake` runs on 1 of 3 vehicles");
    assert_eq!(failure.causes, ["car-0: offline", "car-1: bad"]);
    assert_eq!(exit(&[pending()]).exit, Exit::Differs);
    assert_eq!(exit(&[failed(Exit::LambdaFaulted), failed(Exit::Denied)]).exit, Exit::Denied);
    let many = exit(&vec![pending(); SHOWN + 3]);
    assert_eq!(many.causes.last().unwrap(), "3 more: --json lists all");
}
