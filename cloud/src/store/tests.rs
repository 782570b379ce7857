use gleaner_fleet::people::{NewUser, Role, VehicleState};
use gleaner_fleet::{Cursor, Hello, WantedProblem};
use gleaner_protocol::vehicle_api::GrantStatus;
use gleaner_test_support::cloud::postgres;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::*;

mod ages;
mod identity;
mod numbers;
mod waves;

const KEPT: Retention = Retention { records: 1000, bytes: 1 << 20, vehicle_bytes: 1 << 20 };

/// Returns the address of a database of its own.
pub(crate) async fn address(folder: &TempDir) -> StoreAddress {
    match postgres::store_of(folder.path()).await {
        Some(url) => StoreAddress::server(&url).unwrap(),
        None => StoreAddress::file(&folder.path().join("cloud.db")),
    }
}

impl CloudStore {
    /// Opens an empty database.
    pub(crate) async fn of_test(folder: &TempDir) -> Self {
        Self::open(&address(folder).await).await.unwrap()
    }
}

pub(crate) async fn store() -> (TempDir, CloudStore) {
    let folder = TempDir::new().unwrap();
    let store = CloudStore::of_test(&folder).await;
    (folder, store)
}

/// Enrols a vehicle, which then has this certificate.
async fn enrolled(store: &CloudStore, name: &str, certificate: &str) {
    let token = store.invite_vehicle("ann", name).await.unwrap();
    let issued = || {
        let (sha256, expires) = (certificate.to_owned(), unsigned(now()) + 60);
        Ok(Issued { certificate: String::new(), sha256, renew: expires, expires })
    };
    assert!(store.enrol(name, &token, issued).await.unwrap().is_some());
}

pub(crate) async fn connected(store: &CloudStore, name: &str) -> u64 {
    // Its certificate has its name.
    enrolled(store, name, name).await;
    store.connect(name, name, &Hello::default()).await.unwrap().0
}

pub(super) fn offered(id: &str, release: u64, fleet: &str) -> OfferedDeployment {
    OfferedDeployment {
        id: id.to_owned(),
        release,
        envelope: format!("envelope {release} of {id} for {fleet}"),
        revision: "r".to_owned(),
        fallback: None,
        grants: GrantStatus { record: true, ..GrantStatus::default() },
        selector: [("fleet".to_owned(), fleet.to_owned())].into(),
        revisions: [("r".to_owned(), "a revision".to_owned())].into(),
        waves: None,
    }
}

pub(crate) fn report(labels: Value, deployments: Value) -> VehicleReport {
    let program = json!({ "version": "1.2", "pid": 1, "up_s": 1.0, "rss_bytes": 1, "cpu_s": 1.0 });
    let status = json!({
        "vehicle": "car-7", "key": "k", "labels": labels, "orchestrator": program, "trust": null,
        "generation": 1, "deployments": deployments, "capacity": [], "supervisor": null,
    });
    let json = status.to_string();
    VehicleReport::new(
        1,
        vec![problem("b", "", false)],
        serde_json::from_value(status).unwrap(),
        json,
    )
}

fn problem(deployment: &str, envelope: &str, is_pending: bool) -> WantedProblem {
    let (deployment, envelope) = (deployment.to_owned(), envelope.to_owned());
    let title = "no room".to_owned();
    WantedProblem { deployment, envelope, title, is_pending, ..WantedProblem::default() }
}

fn batch(life: u64, seqs: std::ops::Range<u64>) -> StreamBatch {
    let line = |seq| (seq, String::new(), format!("line {seq}"));
    let cursor = Cursor {
        stream: "events".to_owned(),
        life,
        next: seqs.end,
        seq: seqs.end - 1,
        boot: "b".to_owned(),
        boot_ns: 7,
    };
    StreamBatch { lines: seqs.map(line).collect(), cursor }
}

async fn rows(store: &CloudStore, vehicle: &str) -> Vec<String> {
    let rows = store.rows_after(vehicle, ["events"; 2], (0, 0), 1000).await.unwrap();
    rows.into_iter().map(|(_, line)| line).collect()
}

async fn lines(store: &CloudStore) -> Vec<String> {
    let streams = ["events"; 2];
    let mut lines = store.removed("car-7", streams, 0).await.unwrap();
    lines.extend(rows(store, "car-7").await);
    lines
}

#[tokio::test]
async fn records_that_come_again_are_stored_once() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    for _ in 0..2 {
        let ack = store.append("car-7", epoch, batch(1, 0..3), KEPT).await.unwrap();
        assert_eq!((ack.life, ack.next), (1, 3));
    }
    // A part of it again, and more.
    store.append("car-7", epoch, batch(1, 2..4), KEPT).await.unwrap();
    assert_eq!(lines(&store).await, ["line 0", "line 1", "line 2", "line 3"]);
    let cursor = batch(1, 2..4).cursor;
    let (epoch, cursors) = store.connect("car-7", "car-7", &Hello::default()).await.unwrap();
    assert_eq!(cursors, [cursor]);
    // The vehicle has lost its records, and begins again.
    store.append("car-7", epoch, batch(2, 0..1), KEPT).await.unwrap();
    assert_eq!(lines(&store).await.len(), 5);
    assert!(store.append("car-7", epoch, batch(1, 4..5), KEPT).await.is_err());
}

#[tokio::test]
async fn a_name_of_a_boot_that_cannot_be_stored_takes_no_others_with_it() {
    let (_folder, store) = store().await;
    let (bad, good) = (connected(&store, "bad").await, connected(&store, "car-7").await);
    let mut damaged = batch(1, 0..1);
    damaged.cursor.boot = "b\0".to_owned();
    // PostgreSQL refuses it, and SQLite stores it. Both come in one group.
    let (refused, stored) = tokio::join!(
        store.append("bad", bad, damaged, KEPT),
        store.append("car-7", good, batch(1, 0..1), KEPT),
    );
    if let Err(error) = refused {
        assert!(error.reason().contains("a text cannot be stored"), "{}", error.reason());
    }
    assert_eq!(stored.unwrap().next, 1);
    assert_eq!(lines(&store).await, ["line 0"]);
}

#[tokio::test]
async fn a_connection_that_was_replaced_or_cut_off_stores_nothing() {
    let (_folder, store) = store().await;
    let old = connected(&store, "car-7").await;
    let (new, _) = store.connect("car-7", "car-7", &Hello::default()).await.unwrap();
    assert!(store.append("car-7", old, batch(1, 0..1), KEPT).await.is_err());
    assert!(store.report("car-7", old, report(json!({}), json!([]))).await.is_err());
    assert!(store.append("car-7", new, batch(1, 0..1), KEPT).await.is_ok());
    store.revoke("ann", "car-7").await.unwrap();
    assert!(store.append("car-7", new, batch(1, 1..2), KEPT).await.is_err());
    assert!(store.connect("car-7", "car-7", &Hello::default()).await.is_err());
    assert!(store.wants("car-7").await.is_err());
    assert_eq!(lines(&store).await, ["line 0"]);
    // The earlier certificate does not count again.
    enrolled(&store, "car-7", "second").await;
    assert!(store.connect("car-7", "car-7", &Hello::default()).await.is_err());
    assert!(store.connect("car-7", "second", &Hello::default()).await.is_ok());
}

#[tokio::test]
async fn records_above_the_bounds_are_removed_and_counted() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    let few = Retention { records: 3, ..KEPT };
    store.append("car-7", epoch, batch(1, 0..4), few).await.unwrap();
    store.append("car-7", epoch, batch(1, 4..5), few).await.unwrap();
    let kept = lines(&store).await;
    let gap: Value = serde_json::from_str(&kept[0]).unwrap();
    assert_eq!((&gap["kind"], &gap["record"]["to"]), (&json!("gap"), &json!(1)));
    assert_eq!(gap["record"]["records"], 2);
    assert_eq!(kept[1..], ["line 2", "line 3", "line 4"]);
    // Sent again, a record that was removed does not come back.
    store.append("car-7", epoch, batch(1, 0..2), few).await.unwrap();
    assert_eq!(lines(&store).await, kept);
    let short = Retention { records: 3, bytes: 12, ..KEPT };
    store.append("car-7", epoch, batch(1, 5..6), short).await.unwrap();
    assert_eq!(lines(&store).await[1..], ["line 4", "line 5"]);
}

#[tokio::test]
async fn all_streams_of_a_vehicle_have_a_bound_together() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    let few = Retention { vehicle_bytes: 24, ..KEPT };
    store.append("car-7", epoch, batch(1, 0..3), few).await.unwrap();
    let mut other = batch(1, 3..5);
    other.cursor.stream = "orchestrator".to_owned();
    store.append("car-7", epoch, other, few).await.unwrap();
    let gap = lines(&store).await.remove(0);
    assert!(gap.contains("\"records\":1"), "{gap}");
    assert_eq!(lines(&store).await[1..], ["line 1", "line 2"]);
}

#[tokio::test]
async fn vehicles_are_stored_together_and_an_error_is_of_one_only() {
    let (_folder, store) = store().await;
    let names: Vec<_> = (0..50).map(|number| format!("car-{number}")).collect();
    let mut epochs = Vec::new();
    for name in &names {
        epochs.push(connected(&store, name).await);
    }
    epochs[7] = 99;
    store.append("car-8", epochs[8], batch(2, 0..1), KEPT).await.unwrap();
    let appends = names.iter().zip(&epochs).map(|(name, epoch)| {
        // More than one statement takes.
        store.append(name, *epoch, batch(1, 0..100), KEPT)
    });
    let results = futures_util::future::join_all(appends).await;
    for (number, result) in results.into_iter().enumerate() {
        match number {
            7 => assert!(result.unwrap_err().reason().contains("does not count")),
            8 => assert!(result.unwrap_err().reason().contains("has life 2; this is 1")),
            _ => assert_eq!(result.unwrap().next, 100),
        }
    }
    for (name, count) in [("car-7", 0), ("car-8", 1), ("car-9", 100)] {
        assert_eq!(rows(&store, name).await.len(), count, "{name}");
    }
}

#[tokio::test]
async fn what_the_database_refuses_does_not_take_others_with_it() {
    let (_folder, store) = store().await;
    let (one, other) = (connected(&store, "car-7").await, connected(&store, "car-8").await);
    let refuse = match store.is_file {
        true => {
            "CREATE TRIGGER refuse BEFORE INSERT ON records WHEN NEW.vehicle = 'car-7'
             BEGIN SELECT RAISE(ROLLBACK, 'refused'); END"
        }
        false => "ALTER TABLE records ADD CHECK (vehicle <> 'car-7')",
    };
    store.execute(refuse).await;
    let (refused, stored) = tokio::join!(
        store.append("car-7", one, batch(1, 0..2), KEPT),
        store.append("car-8", other, batch(1, 0..2), KEPT),
    );
    assert!(refused.unwrap_err().is_internal());
    assert_eq!(stored.unwrap().next, 2);
    assert_eq!(rows(&store, "car-8").await.len(), 2);
}

#[tokio::test]
async fn a_certificate_stays_valid_until_the_next_one_is_used() {
    let (_folder, store) = store().await;
    enrolled(&store, "car-7", "first").await;
    enrolled(&store, "car-7", "second").await;
    let connect = async |certificate| store.connect("car-7", certificate, &Hello::default()).await;
    assert!(connect("first").await.is_ok(), "the answer to the enrolment may be lost");
    assert!(connect("second").await.is_ok());
    assert!(connect("first").await.is_err() && store.vehicle_of("first").await.unwrap().is_none());
    assert!(store.vehicle_of("second").await.unwrap().is_some());
}

#[tokio::test]
async fn a_wanted_state_gets_another_number_only_when_it_changes() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    let generation = async || store.wants("car-7").await.unwrap().generation;
    assert_eq!(generation().await, 1);
    let (_, changed) = store.deploy("ann", &offered("a", 1, "test")).await.unwrap();
    assert_eq!((changed.len(), generation().await), (0, 1), "its labels do not fit");
    assert!(
        store.report("car-7", epoch, report(json!({"fleet": "test"}), json!([]))).await.unwrap()
    );
    let wants = store.wants("car-7").await.unwrap();
    assert_eq!((wants.generation, &*wants.deployments[0].id), (2, "a"));
    store.deploy("ann", &offered("b", 1, "other")).await.unwrap();
    store.deploy("ann", &offered("a", 1, "test")).await.unwrap();
    assert_eq!(generation().await, 2);
    assert_eq!(store.set_wanted("ann", "a", false).await.unwrap(), ["car-7"]);
    assert!(!store.wants("car-7").await.unwrap().deployments[0].is_wanted);
    store.deploy("ann", &offered("a", 1, "test")).await.unwrap();
    assert!(store.wants("car-7").await.unwrap().deployments[0].is_wanted);
    assert_eq!(generation().await, 4);
    store.remove_deployment("ann", "a").await.unwrap();
    let wants = store.wants("car-7").await.unwrap();
    assert_eq!((wants.generation, wants.deployments.len()), (5, 0));
}

#[tokio::test]
async fn a_release_is_replaced_only_by_a_higher_one() {
    let (_folder, store) = store().await;
    store.deploy("ann", &offered("a", 5, "test")).await.unwrap();
    for release in [4, 5] {
        let refused = store.deploy("ann", &offered("a", release, "other")).await.unwrap_err();
        let expected = format!("deployment `a` has release 5; this is {release}");
        assert_eq!(refused.reason(), expected);
    }
    store.deploy("ann", &offered("a", 6, "test")).await.unwrap();
    let stored = store.deployment("a").await.unwrap();
    assert!(stored.release == 6 && stored.grants.record);
    let refused = store.roll_back("ann", "a").await.unwrap_err();
    assert_eq!(refused.reason(), "deployment `a` has no fallback");
    let with_fallback = OfferedDeployment { fallback: Some("r".into()), ..offered("a", 7, "test") };
    store.deploy("ann", &with_fallback).await.unwrap();
    store.roll_back("ann", "a").await.unwrap();
    assert!(store.roll_back("ann", "b").await.unwrap_err().reason().contains("no deployment `b`"));
}

#[tokio::test]
async fn codes_work_once_and_tokens_until_their_end() {
    let (_folder, store) = store().await;
    let new = NewUser { name: "ann".to_owned(), role: Role::Deployer };
    let first = store.invite("console", new.clone()).await.unwrap();
    let code = store.invite("console", new).await.unwrap().code;
    assert!(store.login(&first.code).await.unwrap().is_none(), "a later code replaces it");
    let session = store.login(&code).await.unwrap().unwrap();
    assert!(store.login(&code).await.unwrap().is_none());
    let found = store.user(&session.token).await.unwrap().map(|found| found.user);
    assert_eq!(found, Some(session.user));
    assert!(store.user(&code).await.unwrap().is_none(), "a code is no token");
    assert!(store.invite_first().await.unwrap().is_some(), "ann is no administrator");
    store.execute("UPDATE secrets SET expires = 1000").await;
    assert!(store.user(&session.token).await.unwrap().is_none());
    assert!(
        store.invite("console", NewUser { name: "../x".into(), role: Role::Viewer }).await.is_err()
    );
}

#[tokio::test]
async fn a_changed_entry_of_the_audit_trail_is_detected() {
    let (_folder, store) = store().await;
    for name in ["car-1", "car-2", "car-3"] {
        store.invite_vehicle("ann", name).await.unwrap();
    }
    assert_eq!(store.first_changed_entry().await.unwrap(), None);
    assert_eq!(store.audit(u64::MAX, 1).await.unwrap()[0].subject, "car-3");
    store.execute("UPDATE audit SET actor = 'bob' WHERE seq = 2").await;
    assert_eq!(store.first_changed_entry().await.unwrap(), Some(2));
    store.execute("UPDATE audit SET actor = 'ann' WHERE seq = 2").await;
    assert_eq!(store.first_changed_entry().await.unwrap(), None);
    store.execute("DELETE FROM audit WHERE seq = 1").await;
    assert_eq!(store.first_changed_entry().await.unwrap(), Some(1));
}

#[tokio::test]
async fn the_database_of_another_version_is_refused_or_upgraded_by_serve_alone() {
    let (folder, store) = store().await;
    store.execute("INSERT INTO migrations (version) VALUES (99)").await;
    store.close().await;
    let refused = CloudStore::open(&address(&folder).await).await.err().unwrap();
    let expected = format!("the database has version 99; this program has {}", MIGRATIONS.len());
    assert_eq!(refused.message, expected);
    assert!(refused.help.is_some());
    // A backup, or an invitation, beside a cloud of the version before.
    let (folder, store) = self::store().await;
    let last = "DELETE FROM migrations WHERE version = (SELECT MAX(version) FROM migrations)";
    store.execute(last).await;
    store.close().await;
    let refused = CloudStore::in_use(&address(&folder).await).await.err().unwrap();
    let (before, newest) = (MIGRATIONS.len() - 1, MIGRATIONS.len());
    let expected = format!("the database has version {before}; this program has {newest}");
    assert_eq!(refused.message, expected);
    assert!(refused.help.is_some_and(|help| help.contains("`serve`")));
}

#[tokio::test]
async fn vehicles_of_a_process_are_online_as_long_as_its_lease_is() {
    let (folder, store) = store().await;
    store.begin_lease("", false).await.unwrap();
    let epoch = connected(&store, "car-7").await;
    let state = async || store.vehicles("", 9).await.unwrap()[0].state;
    assert_eq!(state().await, VehicleState::Online);
    store.disconnect("car-7", epoch - 1).await.unwrap();
    assert_eq!(state().await, VehicleState::Online, "an older connection changes nothing");
    store.disconnect("car-7", epoch).await.unwrap();
    assert_eq!(state().await, VehicleState::Offline);

    let (epoch, _) = store.connect("car-7", "car-7", &Hello::default()).await.unwrap();
    let link = OwnLink { vehicle: "car-7".to_owned(), epoch, generation: 1 };
    let none = ["car-8".to_owned()];
    assert_eq!(store.own_links(None).await.unwrap(), [link]);
    assert_eq!(store.own_links(Some(&none)).await.unwrap(), []);
    // Another process removes a lease that has ended, and the next renewal is in time again.
    let other = CloudStore::open(&address(&folder).await).await.unwrap();
    assert_eq!(other.own_links(None).await.unwrap(), []);
    store.execute("UPDATE replicas SET until = 1").await;
    other.renew_lease(false).await.unwrap();
    assert_eq!(state().await, VehicleState::Offline);
    store.renew_lease(false).await.unwrap();
    assert_eq!(state().await, VehicleState::Online);
    other.begin_lease(store.replica(), false).await.unwrap();
    assert_eq!(state().await, VehicleState::Offline, "it has ended, and this is its successor");
}

#[tokio::test]
async fn a_process_with_files_of_its_own_ends_when_another_one_has_taken_its_place() {
    let (folder, store) = store().await;
    store.begin_lease("", true).await.unwrap();
    assert!(store.renew_lease(true).await.unwrap());
    // It stood still, and another one has begun.
    store.execute("UPDATE replicas SET until = 1").await;
    let other = CloudStore::open(&address(&folder).await).await.unwrap();
    other.begin_lease("", true).await.unwrap();
    assert!(!store.renew_lease(true).await.unwrap());
    assert!(other.renew_lease(true).await.unwrap(), "the newer one goes on");
    assert!(store.renew_lease(false).await.unwrap(), "with shared files, both do");
}

#[tokio::test]
async fn a_connection_does_not_count_any_more_once_its_vehicle_was_cut_off() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    store.revoke("ann", "car-7").await.unwrap();
    store.invite_vehicle("ann", "car-7").await.unwrap();
    let report = report(json!({}), json!([]));
    assert!(store.report("car-7", epoch, report).await.is_err(), "also if it is invited again");
}

#[test]
fn the_same_tests_pass_on_postgresql() {
    postgres::run_again(
        &["store::", "people::", "page::", "clips::", "records::"],
        "the_same_tests_pass_on_postgresql",
        &[],
    );
}

#[tokio::test]
async fn a_revision_without_a_release_is_removed_after_its_grace() {
    let (_folder, store) = store().await;
    let next = OfferedDeployment {
        revision: "next".to_owned(),
        fallback: Some("r".to_owned()),
        revisions: [("next".to_owned(), "b".to_owned()), ("r".to_owned(), "a".to_owned())].into(),
        ..offered("brake", 2, "test")
    };
    store.deploy("ann", &next).await.unwrap();
    assert_eq!(store.collect_revisions(0).await.unwrap(), 0);
    // The former revision was its fallback only.
    let envelope = "envelope 3".to_owned();
    let later = OfferedDeployment { fallback: None, release: 3, envelope, ..next };
    store.deploy("ann", &later).await.unwrap();
    assert_eq!(store.collect_revisions(3600).await.unwrap(), 0, "it may be needed again");
    assert_eq!(store.collect_revisions(0).await.unwrap(), 1);
    assert!(store.revision("next").await.unwrap().is_some());
    assert!(store.revision("r").await.unwrap().is_none());
}

#[tokio::test]
async fn each_start_is_a_request_of_its_own() {
    let (_folder, store) = store().await;
    connected(&store, "car-7").await;
    let offered = OfferedDeployment { selector: [].into(), ..offered("brake", 1, "test") };
    store.deploy("ann", &offered).await.unwrap();
    let request = async || store.wants("car-7").await.unwrap().deployments[0].start;
    assert_eq!(request().await, 0);
    assert_eq!(store.set_wanted("ann", "brake", true).await.unwrap(), ["car-7"]);
    let first = request().await;
    assert_eq!(store.set_wanted("ann", "brake", true).await.unwrap(), ["car-7"]);
    assert!(first > 0 && request().await > first);
}

#[test]
fn a_database_that_is_away_is_no_fault_of_the_cloud() {
    let away = CloudError::from(sqlx::Error::PoolTimedOut);
    assert_eq!(away.status().as_u16(), 503);
    assert!(away.reason().starts_with("the database cannot be reached"), "{}", away.reason());
}
