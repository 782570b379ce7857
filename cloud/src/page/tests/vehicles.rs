use super::*;

#[tokio::test]
async fn a_fallback_that_runs_is_shown_as_what_it_is_with_what_failed() {
    let (_folder, cloud) = Cloud::of_test().await;
    cloud.store.invite_vehicle("console", "car-1").await.unwrap();
    let program = json!({ "version": "1", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 });
    let revision =
        |digest: &str, version: &str| json!({ "digest": digest, "version": version, "release": 1 });
    let lambda = json!({ "id": "brake", "name": "brake", "revision": "bbbb", "attempt": 2,
                         "phase": "running", "phase_s": 1.0, "pid": null, "restarts": 0,
                         "last_end": null, "live": null, "layers": [] });
    let mut deployment = json!({ "id": "brake", "release": 7, "attempt": 2, "lambda": "brake",
        "revision": revision("aaaa", "1.4.0"), "fallback": revision("bbbb", "1.3.0"),
        "grants": { "topics": [], "models": [], "record": false }, "is_wanted": true,
        "runs_fallback": true, "is_proven": true, "failed": "it faults", "refused": null,
        "stale": null, "status": lambda });
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    for (reason, words) in
        [("it faults", "failed: it faults"), ("rolled back by a user", "was rolled")]
    {
        deployment["failed"] = json!(reason);
        let status = json!({ "vehicle": "car-1", "key": "k", "labels": {}, "trust": null,
            "orchestrator": program, "generation": 1, "deployments": [deployment],
            "capacity": [], "supervisor": null });
        let update = "UPDATE vehicles SET epoch = 1, status = $1";
        cloud.store.execute_with(update, &[&status.to_string()]).await;
        let page = user.get("/vehicles/car-1").await;
        for expected in [
            "<span class=\"state waiting\">runs its fallback</span>",
            "brake 1.3.0 <span class=\"warn\">(fallback)</span>, release 7, revision \
             <code>bbbb</code>",
            &format!("release 7 (1.4.0) {words}"),
        ] {
            assert!(page.has(expected), "{expected}: {}", page.text);
        }
    }
}

#[tokio::test]
async fn records_of_several_streams_are_listed_by_their_times() {
    let (_folder, cloud) = Cloud::of_test().await;
    cloud.store.invite_vehicle("console", "car-1").await.unwrap();
    cloud.store.execute("UPDATE vehicles SET arrived = 2").await;
    for (stream, arrival, time) in [("events", "1", 5), ("orchestrator", "2", 4)] {
        let line = json!({ "stream": stream, "seq": 0, "time_ns": time, "boot_ns": time,
                           "boot": "b", "kind": stream, "record": {} });
        let insert = "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns)
                      VALUES ('car-1', $1, 1, 1, 0, '', 0)";
        cloud.store.execute_with(insert, &[stream]).await;
        let insert = "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                      VALUES ('car-1', $1, 1, 0, '', CAST($3 AS BIGINT), $2, 1)";
        cloud.store.execute_with(insert, &[stream, &line.to_string(), arrival]).await;
    }
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    let page = user.get("/vehicles/car-1/events").await.text;
    let place = |kind: &str| page.find(&format!(">{kind}</span>")).expect(kind);
    assert!(place("events") < place("orchestrator"), "the newest first: {page}");
}
