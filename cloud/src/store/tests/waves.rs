use std::collections::BTreeMap;

use gleaner_fleet::waves::{OnFailure, WavePlan, WaveProgress, WaveState};

use super::super::sql::TextMap;
use super::super::waves::{AWAY_S, WAVES};
use super::*;

const PLAN: WavePlan = WavePlan {
    shares: Vec::new(),
    success: 90,
    failures: 10,
    soak_s: 0,
    deadline_s: 3600,
    on_failure: OnFailure::Pause,
};

/// A store with vehicles that run release 1 of the deployment `a`.
struct TestFleet {
    folder: TempDir,
    store: CloudStore,
    epochs: BTreeMap<String, u64>,
}

impl TestFleet {
    async fn of(vehicles: usize) -> Self {
        let (folder, store) = store().await;
        store.begin_lease("", false).await.unwrap();
        let mut epochs = BTreeMap::new();
        for number in 0..vehicles {
            let name = format!("car-{number}");
            epochs.insert(name.clone(), connected(&store, &name).await);
        }
        store.deploy("ann", &release(1, None)).await.unwrap();
        Self { folder, store, epochs }
    }

    async fn deploy(&self, number: u64, plan: WavePlan) {
        self.store.deploy("ann", &release(number, Some(plan))).await.unwrap();
    }

    /// Returns the vehicles that should have a release.
    async fn having(&self, number: u64) -> Vec<String> {
        let mut names = Vec::new();
        let sha256 = envelope(number);
        for name in self.epochs.keys() {
            let wants = self.store.wants(name).await.unwrap();
            if wants.deployments.iter().any(|wanted| wanted.envelope == sha256) {
                names.push(name.clone());
            }
        }
        names
    }

    async fn report(&self, names: &[String], number: u64, failed: Option<&str>) {
        for name in names {
            let deployment = json!([{
                "id": "a", "release": number, "envelope": envelope(number), "attempt": 1, "lambda": "a",
                "revision": { "digest": "r", "version": "1", "release": 1 }, "fallback": null,
                "grants": { "topics": [], "models": [], "record": false }, "is_wanted": true,
                "runs_fallback": failed.is_some(), "is_proven": false, "failed": failed,
                "refused": null, "stale": null,
                "status": { "id": "a", "name": "a", "revision": "r", "attempt": 1,
                    "phase": "running", "phase_s": 1.0, "pid": null, "restarts": 0,
                    "last_end": null, "live": null, "layers": [] },
            }]);
            let handled = self.store.wants(name).await.unwrap().generation;
            let report = VehicleReport { handled, ..report(json!({}), deployment) };
            self.store.report(name, self.epochs[name], report).await.unwrap();
        }
    }

    async fn progress(&self) -> WaveProgress {
        self.store.deployment("a").await.unwrap().waves.unwrap()
    }

    /// Moves the time at which the wave opened back.
    async fn pass(&self, seconds: i64) {
        let query = sqlx::query("UPDATE releases SET since = since - $1").bind(seconds);
        query.execute(&self.store.pool).await.unwrap();
    }
}

fn envelope(number: u64) -> String {
    gleaner_trust::sha256(release(number, None).envelope.as_bytes()).to_string()
}

fn release(number: u64, waves: Option<WavePlan>) -> OfferedDeployment {
    let fallback = Some("r".to_owned());
    OfferedDeployment { selector: [].into(), fallback, waves, ..offered("a", number, "test") }
}

#[tokio::test]
async fn a_wave_opens_once_the_one_before_has_succeeded() {
    let fleet = TestFleet::of(10).await;
    fleet.deploy(2, WavePlan { shares: vec![10, 50], ..PLAN }).await;
    let first = fleet.having(2).await;
    assert_eq!((first.len(), fleet.having(1).await.len()), (1, 9));
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    fleet.report(&first, 2, None).await;
    let changed = fleet.store.advance_waves().await.unwrap();
    let second = fleet.having(2).await;
    assert_eq!((changed.len(), second.len()), (4, 5));
    assert!(second.contains(&first[0]) && !changed.contains(&first[0]));
    assert!(fleet.store.advance_waves().await.unwrap().is_empty(), "a step is taken once");
    let progress = fleet.progress().await;
    assert_eq!((progress.wave, progress.waves), (2, 3));
    assert_eq!((progress.vehicles, progress.running, progress.failed), (5, 1, 0));
    fleet.report(&second, 2, None).await;
    assert_eq!(fleet.store.advance_waves().await.unwrap().len(), 5);
    assert_eq!(fleet.having(2).await.len(), 10);
    let stored = fleet.store.deployment("a").await.unwrap();
    assert_eq!((stored.waves, stored.running, stored.vehicles), (None, 5, 10));
    let (releases,): (i64,) =
        sqlx::query_as("SELECT COUNT(*) FROM releases").fetch_one(&fleet.store.pool).await.unwrap();
    assert_eq!(releases, 1);
    let steps: Vec<_> = fleet.store.audit(u64::MAX, 100).await.unwrap();
    let steps: Vec<_> = steps.iter().filter(|it| it.actor == WAVES).map(|it| &*it.action).collect();
    assert_eq!(steps, ["open release 2 to all", "open wave 2 of release 2"]);
}

#[tokio::test]
async fn two_processes_take_a_step_once() {
    let fleet = TestFleet::of(10).await;
    let other = CloudStore::open(&address(&fleet.folder).await).await.unwrap();
    fleet.deploy(2, WavePlan { shares: vec![10, 50], ..PLAN }).await;
    fleet.report(&fleet.having(2).await, 2, None).await;
    let looks = async |store: &CloudStore| {
        let mut changed = 0;
        for _ in 0..5 {
            changed += store.advance_waves().await.unwrap().len();
        }
        changed
    };
    let (here, there) = tokio::join!(looks(&fleet.store), looks(&other));
    assert_eq!(here + there, 4, "vehicles of the second wave");
    let audit = fleet.store.audit(u64::MAX, 100).await.unwrap();
    assert_eq!(audit.iter().filter(|it| it.actor == WAVES).count(), 1);
}

#[tokio::test]
async fn waves_stop_at_failures_until_a_person_resumes_them() {
    let fleet = TestFleet::of(4).await;
    fleet.deploy(2, WavePlan { shares: vec![50], success: 50, ..PLAN }).await;
    let first = fleet.having(2).await;
    fleet.report(&first[..1], 2, None).await;
    fleet.report(&first[1..], 2, Some("it faults")).await;
    fleet.store.advance_waves().await.unwrap();
    let progress = fleet.progress().await;
    assert_eq!(progress.state, WaveState::Paused);
    assert_eq!(progress.reason, format!("failed on 1 of 2 ({}: it faults)", first[1]));
    // The fallback runs there: that is no success.
    let stored = fleet.store.deployment("a").await.unwrap();
    assert_eq!((stored.running, stored.failed, stored.on_fallback), (1, 1, 1));
    let reports = fleet.store.reports("a", &envelope(2), 9).await.unwrap();
    assert_eq!(reports[0], (first[1].clone(), "fallback".to_owned(), "it faults".to_owned()));
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    assert_eq!(fleet.having(2).await, first);
    // Who resumes them accepts the failures so far.
    fleet.store.steer_waves("ann", "a", WaveState::Running).await.unwrap();
    assert_eq!(fleet.store.advance_waves().await.unwrap().len(), 2);
    let refused = fleet.store.steer_waves("ann", "a", WaveState::Paused).await.unwrap_err();
    assert_eq!(refused.reason(), "release 2 of `a` is open to all its vehicles");
}

#[tokio::test]
async fn a_plan_that_cannot_be_followed_changes_nothing() {
    let fleet = TestFleet::of(2).await;
    for shares in [vec![], vec![0], vec![50, 50], vec![100], (1..30).collect()] {
        let bad = release(2, Some(WavePlan { shares, ..PLAN }));
        let refused = fleet.store.deploy("ann", &bad).await.unwrap_err().reason();
        assert!(refused.starts_with("the plan of the waves is refused: "), "{refused}");
    }
    assert_eq!(fleet.having(1).await.len(), 2);
    assert_eq!(fleet.store.deployment("a").await.unwrap().release, 1);
}

#[tokio::test]
async fn failures_of_other_vehicles_count_after_waves_were_resumed() {
    let fleet = TestFleet::of(10).await;
    let plan = WavePlan { shares: vec![50], success: 50, failures: 20, soak_s: 60, ..PLAN };
    fleet.deploy(2, plan).await;
    let first = fleet.having(2).await;
    fleet.report(&first[..3], 2, None).await;
    fleet.report(&first[3..], 2, Some("it faults")).await;
    fleet.store.advance_waves().await.unwrap();
    assert_eq!(fleet.progress().await.state, WaveState::Paused);
    fleet.store.steer_waves("ann", "a", WaveState::Running).await.unwrap();
    fleet.report(&first[3..], 2, None).await;
    fleet.report(&first[..2], 2, Some("it faults")).await;
    fleet.store.advance_waves().await.unwrap();
    assert_eq!(fleet.progress().await.state, WaveState::Paused);
}

#[tokio::test]
async fn the_time_of_a_wave_does_not_run_while_its_deployment_is_stopped() {
    let fleet = TestFleet::of(2).await;
    fleet.deploy(2, WavePlan { shares: vec![50], soak_s: 60, ..PLAN }).await;
    fleet.report(&fleet.having(2).await, 2, None).await;
    fleet.store.set_wanted("ann", "a", false).await.unwrap();
    fleet.pass(7200).await;
    fleet.store.set_wanted("ann", "a", true).await.unwrap();
    fleet.report(&fleet.having(2).await, 2, None).await;
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    assert_eq!(fleet.progress().await.state, WaveState::Running);
}

#[tokio::test]
async fn a_failed_wave_runs_the_fallback_if_the_plan_says_so() {
    let fleet = TestFleet::of(3).await;
    let on_failure = OnFailure::Rollback;
    fleet.deploy(2, WavePlan { shares: vec![30], on_failure, ..PLAN }).await;
    let first = fleet.having(2).await;
    fleet.report(&first, 2, Some("it faults")).await;
    assert_eq!(fleet.store.advance_waves().await.unwrap(), first);
    assert!(fleet.store.wants(&first[0]).await.unwrap().deployments[0].rollback > 0);
    assert_eq!(fleet.progress().await.state, WaveState::Aborted);
    let others = fleet.having(1).await;
    assert_eq!(others.len(), 2);
    assert_eq!(fleet.store.wants(&others[0]).await.unwrap().deployments[0].rollback, 0);
}

#[tokio::test]
async fn a_wave_waits_for_its_soak_time_and_pauses_at_its_deadline() {
    let fleet = TestFleet::of(4).await;
    fleet.deploy(2, WavePlan { shares: vec![25, 50], soak_s: 60, ..PLAN }).await;
    let first = fleet.having(2).await;
    fleet.report(&first, 2, None).await;
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    fleet.pass(60).await;
    assert_eq!(fleet.store.advance_waves().await.unwrap().len(), 1);
    fleet.pass(3600).await;
    fleet.store.advance_waves().await.unwrap();
    let progress = fleet.progress().await;
    assert_eq!(progress.state, WaveState::Paused);
    assert_eq!(progress.reason, "ran on 1 of 2 at its deadline");
}

#[tokio::test]
async fn a_wave_does_not_wait_for_vehicles_that_are_switched_off() {
    let fleet = TestFleet::of(6).await;
    fleet.deploy(2, WavePlan { shares: vec![50], ..PLAN }).await;
    let first = fleet.having(2).await;
    // Of the two that are switched off then, one has run it.
    fleet.report(&first[..2], 2, None).await;
    let others = "UPDATE vehicles SET seen = seen - 100000, replica = '' WHERE name <> $1";
    fleet.store.execute_with(others, &[&first[0]]).await;
    assert!(fleet.store.advance_waves().await.unwrap().is_empty(), "they may connect soon");
    fleet.pass(AWAY_S + 1).await;
    assert_eq!(fleet.store.advance_waves().await.unwrap().len(), 3);
    // Nothing succeeds without any vehicle that runs it, or with one that has fallen silent since.
    fleet.deploy(3, WavePlan { shares: vec![10], ..PLAN }).await;
    fleet.pass(AWAY_S + 1).await;
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    let canary = fleet.having(3).await;
    fleet.report(&canary, 3, None).await;
    fleet.store.execute_with(others, &[""]).await;
    assert!(fleet.store.advance_waves().await.unwrap().is_empty());
    assert_eq!(fleet.store.deployment("a").await.unwrap().running, 1, "as it was reported");
    fleet.pass(3600).await;
    fleet.store.advance_waves().await.unwrap();
    let end = format!("0 of 1 at its deadline ({}: not connected since the soak time)", canary[0]);
    assert!(fleet.progress().await.reason.ends_with(&end));
}

#[tokio::test]
async fn the_first_vehicle_of_a_fleet_gets_a_wave_that_was_open_before() {
    let (_folder, store) = store().await;
    let plan = WavePlan { shares: vec![10], ..PLAN };
    store.deploy("ann", &release(1, Some(plan))).await.unwrap();
    assert!(store.advance_waves().await.unwrap().is_empty());
    connected(&store, "car-1").await;
    assert_eq!(store.advance_waves().await.unwrap(), ["car-1"]);
    assert!(store.advance_waves().await.unwrap().is_empty());
}

#[tokio::test]
async fn a_newer_release_ends_the_waves_of_the_one_before_and_takes_nothing_back() {
    let fleet = TestFleet::of(4).await;
    fleet.deploy(2, WavePlan { shares: vec![50], ..PLAN }).await;
    let second = fleet.having(2).await;
    fleet.deploy(3, WavePlan { shares: vec![25], ..PLAN }).await;
    let third = fleet.having(3).await;
    assert_eq!(third.len(), 1);
    // A vehicle would refuse the release before the one that it has.
    let left: Vec<_> = second.iter().filter(|name| !third.contains(name)).cloned().collect();
    assert_eq!(fleet.having(2).await, left);
    fleet.store.steer_waves("ann", "a", WaveState::Aborted).await.unwrap();
    let refused = fleet.store.steer_waves("ann", "a", WaveState::Running).await.unwrap_err();
    assert_eq!(refused.reason(), "release 3 of `a` was aborted");
    assert_eq!(fleet.having(3).await, third);
    for number in 4..9 {
        fleet.deploy(number, WavePlan { shares: vec![25], ..PLAN }).await;
    }
    let plan = WavePlan { shares: vec![25], ..PLAN };
    let refused = fleet.store.deploy("ann", &release(9, Some(plan))).await.unwrap_err();
    assert!(refused.reason().contains("has 8 releases"), "{}", refused.reason());
    fleet.store.deploy("ann", &release(9, None)).await.unwrap();
    assert_eq!(fleet.having(9).await.len(), 4);
    fleet.store.remove_deployment("ann", "a").await.unwrap();
    assert!(fleet.store.deployments("", 1).await.unwrap().is_empty());
}

#[tokio::test]
async fn a_vehicle_whose_labels_change_leaves_the_waves() {
    let fleet = TestFleet::of(2).await;
    let selector: TextMap = [("site".to_owned(), "berlin".to_owned())].into();
    let plan = WavePlan { shares: vec![50], ..PLAN };
    let second = OfferedDeployment { selector, ..release(2, Some(plan)) };
    fleet.store.deploy("ann", &second).await.unwrap();
    assert!(fleet.having(2).await.is_empty());
    for (site, expected) in [("berlin", 1), ("paris", 0)] {
        let labels = report(json!({ "site": site }), json!([]));
        fleet.store.report("car-0", fleet.epochs["car-0"], labels).await.unwrap();
        fleet.store.advance_waves().await.unwrap();
        assert_eq!(fleet.having(2).await.len(), expected, "{site}");
    }
    assert_eq!(fleet.progress().await.vehicles, 0);
    assert_eq!(fleet.having(1).await.len(), 2);
}

#[tokio::test]
async fn a_database_of_the_first_version_keeps_its_deployments() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("cloud.db");
    sqlx::install_own_drivers();
    let url = format!("sqlite://{}?mode=rwc", path.display());
    let pool = sqlx::AnyPool::connect(&url).await.unwrap();
    let first = include_str!("../../../migrations/0001_start.sql");
    for sql in [
        first,
        "CREATE TABLE migrations (version BIGINT PRIMARY KEY)",
        "INSERT INTO migrations VALUES (1)",
        "INSERT INTO revisions VALUES ('r', 'a revision')",
        "INSERT INTO deployments VALUES ('a', 7, 's', 'e', 'r', 'f', '{}', '{\"x\":\"y\"}', 0, 9)",
    ] {
        sqlx::raw_sql(sql).execute(&pool).await.unwrap();
    }
    pool.close().await;
    let store = CloudStore::open(&StoreAddress::file(&path)).await.unwrap();
    let stored = store.deployment("a").await.unwrap();
    assert_eq!((stored.release, stored.is_wanted, stored.waves), (7, false, None));
    assert_eq!((stored.fallback.as_deref(), &*stored.selector["x"]), (Some("f"), "y"));
    assert_eq!(store.envelope("s").await.unwrap().as_deref(), Some("e"));
    connected(&store, "car-1").await;
    store.connect("car-1", "car-1", &Hello::default()).await.unwrap();
    store.deploy("ann", &release(8, None)).await.unwrap();
    assert_eq!(store.wants("car-1").await.unwrap().deployments.len(), 1);
}
