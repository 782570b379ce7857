use super::*;

#[tokio::test]
async fn vehicles_of_a_deployment_are_counted_by_what_they_report() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    connected(&store, "car-8").await;
    let deployment = OfferedDeployment { selector: [].into(), ..offered("a", 1, "test") };
    store.deploy("ann", &deployment).await.unwrap();
    let counts = async || {
        let a = store.deployment("a").await.unwrap();
        (a.vehicles, a.running, a.failed)
    };
    assert_eq!(counts().await, (2, 0, 0));
    let envelope = gleaner_trust::sha256(deployment.envelope.as_bytes()).to_string();
    let status = |refused: Value, phase: &str, envelope: &str| {
        json!([{
            "id": "a", "release": 1, "envelope": envelope, "attempt": 1, "lambda": "a",
            "revision": { "digest": "r", "version": "1", "release": 1 }, "fallback": null,
            "grants": { "topics": [], "models": [], "record": false }, "is_wanted": true,
            "runs_fallback": false, "is_proven": false, "failed": null, "refused": refused,
            "stale": null,
            "status": { "id": "a", "name": "a", "revision": "r", "attempt": 1, "phase": phase,
                "phase_s": 1.0, "pid": null, "restarts": 0, "last_end": null, "live": null,
                "layers": [] },
        }])
    };
    for (refused, phase, expected) in
        [(Value::Null, "running", (2, 1, 0)), (json!("no room"), "waiting", (2, 0, 1))]
    {
        let deployments = status(refused, phase, &envelope);
        store.report("car-7", epoch, report(json!({}), deployments)).await.unwrap();
        assert_eq!(counts().await, expected);
    }
    // Its wakes fault, and it has no fallback: proven, of an earlier attempt, in its probation.
    let mut faulty = status(Value::Null, "running", &envelope);
    faulty[0]["status"]["recent"] = json!({ "wakes": 20, "faults": 10, "backed_off": 0 });
    for (is_proven, attempt, running) in [(true, 1, 1), (false, 2, 1), (false, 1, 0)] {
        faulty[0]["is_proven"] = json!(is_proven);
        faulty[0]["attempt"] = json!(attempt);
        store.report("car-7", epoch, report(json!({}), faulty.clone())).await.unwrap();
        assert_eq!(counts().await, (2, running, 1 - running));
    }
    assert!(store.reports("a", &envelope, 9).await.unwrap()[0].2.starts_with("10 of its last 20"));
    // Another deployment of the same number, with and without a problem of this one, of another
    // one, and with one that could only not be fetched yet.
    let other = status(Value::Null, "running", "other");
    for (problem, expected) in [
        (problem("a", "older", false), (2, 0, 0)),
        (problem("a", &envelope, false), (2, 0, 1)),
        (problem("a", &envelope, true), (2, 0, 0)),
    ] {
        let json = report(json!({}), other.clone()).status;
        let status = serde_json::from_str(&json).unwrap();
        let report = VehicleReport::new(2, vec![problem.clone()], status, json);
        store.report("car-7", epoch, report).await.unwrap();
        assert_eq!(counts().await, expected, "{problem:?}");
    }
    assert_eq!(store.reported_releases("a", 9).await.unwrap()[0].release, 1);
    store.revoke("ann", "car-7").await.unwrap();
    assert!(store.reported_releases("a", 9).await.unwrap().is_empty());
    store.invite_vehicle("ann", "car-7").await.unwrap();
    let all = store.vehicles("", 10).await.unwrap();
    assert_eq!((all[0].wanted, all[0].handled, &*all[0].problems[0].title), (2, 2, "no room"));
}

#[tokio::test]
async fn of_two_machines_with_one_identity_only_one_is_let_in_until_it_is_enrolled_again() {
    let (_folder, store) = store().await;
    connected(&store, "car-7").await;
    let connect = async |boot: &str| {
        let hello = Hello { boot: boot.to_owned(), ..Hello::default() };
        store.connect("car-7", "car-7", &hello).await.map_err(|error| error.reason())
    };
    let is_double = async || store.vehicles("", 1).await.unwrap()[0].is_double;
    // A machine that starts again has another boot, also several times.
    for boot in ["a", "a", "b", "c"] {
        connect(boot).await.unwrap();
    }
    assert!(!is_double().await);
    connect("copy").await.unwrap();
    // Once, a program may have moved from one machine to another and back.
    let newest = connect("c").await.unwrap();
    assert!(!is_double().await);
    let refused = connect("copy").await.unwrap_err();
    assert!(refused.contains("another machine has the identity of `car-7`"), "{refused}");
    assert!(is_double().await);
    // The connection of the other one still counts.
    store.report("car-7", newest.0, report(json!({}), json!([]))).await.unwrap();
    assert!(connect("copy").await.is_err() && connect("c").await.is_ok());
    enrolled(&store, "car-7", "next").await;
    assert!(!is_double().await);
    connect("copy").await.unwrap();
}

#[tokio::test]
async fn a_vehicle_that_followed_a_newer_state_keeps_what_it_has_until_a_person_agrees() {
    let (_folder, store) = store().await;
    store.begin_lease("", true).await.unwrap();
    connected(&store, "car-7").await;
    let deployment = OfferedDeployment { selector: [].into(), ..offered("a", 1, "test") };
    store.deploy("ann", &deployment).await.unwrap();
    let wants = async || {
        let wants = store.wants("car-7").await.unwrap();
        let is_ahead = store.vehicles("", 1).await.unwrap()[0].is_ahead;
        assert_eq!(wants.keeps, is_ahead);
        (wants.generation, wants.keeps)
    };
    let connect = async |followed| {
        let hello = Hello { followed, ..Hello::default() };
        store.connect("car-7", "car-7", &hello).await.map(drop)
    };
    let before = wants().await;
    connect(before.0).await.unwrap();
    assert_eq!(wants().await, (before.0, false));
    // A state that comes while it is away may have the number of another one.
    store.execute("UPDATE vehicles SET replica = ''").await;
    store.deploy("ann", &OfferedDeployment { id: "b".into(), ..deployment.clone() }).await.unwrap();
    assert_eq!(wants().await, (before.0 + 1, false));
    connect(before.0 + 1).await.unwrap();
    assert_eq!(wants().await, (before.0 + 2, true));
    store.agree("ann", "car-7").await.unwrap();
    // The database is of a backup. What is deployed from now on has higher numbers.
    connect(90).await.unwrap();
    assert_eq!(wants().await, (91, true));
    store.deploy("ann", &OfferedDeployment { id: "c".into(), ..deployment }).await.unwrap();
    assert_eq!(wants().await, (92, true));
    connect(91).await.unwrap();
    assert_eq!(wants().await, (92, true), "nobody has agreed");
    store.agree("ann", "car-7").await.unwrap();
    assert_eq!(wants().await, (93, false));
    assert!(store.agree("ann", "car-8").await.is_err());
    // No number that cannot be counted up.
    for followed in [1 << 62, u64::MAX] {
        assert!(connect(followed).await.is_err());
    }
}
