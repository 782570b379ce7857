//! This process as one of several that serve the same PostgreSQL database: it keeps its lease, and
//! learns there what the others have changed.
//!
//! It looks every two seconds, and at once at what a hint names: without hints, changes arrive that
//! much later, and nothing else is different.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::try_join_all;
use gleaner_base::{Exit, Failure};
use tokio::sync::watch;
use tokio::time::sleep;

use crate::bus::ReceivedHints;
use crate::error::CloudResult;
use crate::hub::Hub;
use crate::live_streams;
use crate::store::{CloudStore, OwnLink};
use crate::ticks::ticks;

/// Interval of looks. With a look that takes its time, a revoked vehicle is disconnected in 5 s.
const LOOK: Duration = Duration::from_secs(2);
/// Interval at which the lease is renewed.
const RENEW: Duration = Duration::from_secs(4);
/// Least time between two looks that hints cause.
const PAUSE: Duration = Duration::from_millis(20);

/// Keeps the lease of this process, for as long as it runs. One that has its files for itself ends
/// if another one has taken its place, as when its machine stood still: then it stores nothing any
/// more, and `failed` has the reason.
pub(crate) async fn keep_lease(
    store: &CloudStore,
    is_alone: bool,
    failed: watch::Sender<Option<Failure>>,
) {
    let mut ticks = ticks(RENEW);
    loop {
        ticks.tick().await;
        match store.renew_lease(is_alone).await {
            Ok(true) => {}
            Ok(false) => {
                let message = "another gleaner-cloud has begun to serve the database, as the lease \
                               of this one had ended";
                let help = "check which of both should run: each has files of its own; with \
                            --objects s3://BUCKET, several can serve a new database";
                failed.send_replace(Some(Failure::new(Exit::Differs, message).with_help(help)));
                return store.close().await;
            }
            Err(error) => {
                tracing::warn!(reason = error.reason(), "could not renew the lease; will retry");
            }
        }
    }
}

/// Follows the changes of other replicas, for as long as this process runs.
pub(crate) async fn follow(store: &CloudStore, hub: &Hub, hints: Option<Arc<ReceivedHints>>) {
    let mut ticks = ticks(LOOK);
    let mut follower = ReplicaFollower::default();
    let mut has_failed = false;
    loop {
        let look = match &hints {
            None => {
                ticks.tick().await;
                follower.look(store, hub).await
            }
            Some(hints) => tokio::select! {
                _ = ticks.tick() => follower.look(store, hub).await,
                hinted = hints.next() => {
                    sleep(PAUSE).await;
                    let changed: Vec<_> = hinted.changed.into_iter().collect();
                    let looked = follower.look_at_links((store, hub), Some(&changed)).await;
                    hub.arrived_elsewhere(&hinted.with_records);
                    match hinted.has_live_streams {
                        true => looked.and(live_streams::deliver(store, hub).await),
                        false => looked,
                    }
                }
            },
        };
        match look {
            Err(error) if !has_failed => {
                let reason = error.reason();
                tracing::warn!(reason, "could not read changes of other replicas; will retry");
                has_failed = true;
            }
            Ok(()) => has_failed = false,
            Err(_) => {}
        }
    }
}

/// The findings of the last look.
#[derive(Debug, Default)]
struct ReplicaFollower {
    /// Last arrivals of the vehicles whose records are read.
    arrivals: BTreeMap<String, i64>,
    /// Connections of this process in the database that it does not have.
    missing: BTreeSet<(String, u64)>,
}

impl ReplicaFollower {
    async fn look(&mut self, store: &CloudStore, hub: &Hub) -> CloudResult<()> {
        self.look_at_links((store, hub), None).await?;
        live_streams::deliver(store, hub).await?;
        self.look_at_records(store, hub).await
    }

    /// Ends connections that do not count any more, and wakes those with another desired state.
    async fn look_at_links(
        &mut self,
        (store, hub): (&CloudStore, &Hub),
        only: Option<&[String]>,
    ) -> CloudResult<()> {
        // First the connections: one that begins after this is not in question.
        let open = hub.open_links(only);
        if only.is_some() && open.is_empty() {
            return Ok(());
        }
        let names: Option<Vec<String>> = only.map(|_| open.keys().cloned().collect());
        let own = store.own_links(names.as_deref()).await?;
        let missing = hub.compare(&open, &own);
        if only.is_some() {
            return Ok(());
        }
        // One that was missing before has ended while its end could not be stored.
        // All at once: the writer stores them with a few statements.
        let ended = missing.intersection(&self.missing);
        try_join_all(ended.map(|(vehicle, epoch)| store.disconnect(vehicle, *epoch))).await?;
        self.missing = missing;
        Ok(())
    }

    async fn look_at_records(&mut self, store: &CloudStore, hub: &Hub) -> CloudResult<()> {
        let vehicles = hub.read_vehicles();
        self.arrivals.retain(|name, _| vehicles.contains(name));
        let mut arrived = BTreeSet::new();
        for name in vehicles {
            let last = store.arrived(&name).await?;
            // The first time, a reader may have looked before it.
            if self.arrivals.insert(name.clone(), last) != Some(last) {
                arrived.insert(name);
            }
        }
        hub.arrived_elsewhere(&arrived);
        Ok(())
    }
}

impl OwnLink {
    /// Returns the vehicle and the epoch.
    pub(crate) fn key(&self) -> (String, u64) {
        (self.vehicle.clone(), self.epoch)
    }
}
