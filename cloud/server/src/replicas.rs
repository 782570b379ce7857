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
use crate::cloud::Cloud;
use crate::error::CloudResult;
use crate::store::OwnLink;
use crate::tails;
use crate::ticks::ticks;

/// Interval of looks. With a look that takes its time, a revoked vehicle is cut off within 5 s.
const LOOK: Duration = Duration::from_secs(2);
/// Interval at which the lease is renewed.
const RENEW: Duration = Duration::from_secs(4);
/// Least time between two looks that hints cause.
const PAUSE: Duration = Duration::from_millis(20);

/// Keeps the lease of this process, for as long as it runs. One that has its files for itself ends
/// if another one has taken its place, as when its machine stood still: then it stores nothing any
/// more, and `failed` has the reason.
pub(crate) async fn keep_lease(
    cloud: &Cloud,
    is_alone: bool,
    failed: watch::Sender<Option<Failure>>,
) {
    let mut ticks = ticks(RENEW);
    loop {
        ticks.tick().await;
        match cloud.store.renew_lease(is_alone).await {
            Ok(true) => {}
            Ok(false) => {
                let message = "another gleaner-cloud has begun to serve the database, as the lease \
                               of this one had ended";
                let help = "check which of both should run: each has files of its own; with \
                            --objects s3://BUCKET, several can serve a new database";
                failed.send_replace(Some(Failure::new(Exit::Differs, message).with_help(help)));
                return cloud.store.close().await;
            }
            Err(error) => {
                tracing::warn!(reason = error.reason(), "the lease of this process is not renewed");
            }
        }
    }
}

/// Follows the changes of other replicas, for as long as this process runs.
pub(crate) async fn follow(cloud: &Cloud, hints: Option<Arc<ReceivedHints>>) {
    let mut ticks = ticks(LOOK);
    let mut follower = ReplicaFollower::default();
    let mut has_failed = false;
    loop {
        let look = match &hints {
            None => {
                ticks.tick().await;
                follower.look(cloud).await
            }
            Some(hints) => tokio::select! {
                _ = ticks.tick() => follower.look(cloud).await,
                hinted = hints.next() => {
                    sleep(PAUSE).await;
                    let changed: Vec<_> = hinted.changed.into_iter().collect();
                    let looked = follower.look_at_links(cloud, Some(&changed)).await;
                    cloud.hub.arrived_elsewhere(&hinted.with_records);
                    match hinted.has_tails {
                        true => looked.and(tails::deliver(cloud).await),
                        false => looked,
                    }
                }
            },
        };
        match look {
            Err(error) if !has_failed => {
                let reason = error.reason();
                tracing::warn!(reason, "changes of other replicas cannot be read");
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
    async fn look(&mut self, cloud: &Cloud) -> CloudResult<()> {
        self.look_at_links(cloud, None).await?;
        tails::deliver(cloud).await?;
        self.look_at_records(cloud).await
    }

    /// Ends connections that do not count any more, and wakes those with another wanted state.
    async fn look_at_links(&mut self, cloud: &Cloud, only: Option<&[String]>) -> CloudResult<()> {
        // First the connections: one that begins after this is not in question.
        let open = cloud.hub.open_links(only);
        if only.is_some() && open.is_empty() {
            return Ok(());
        }
        let names: Option<Vec<String>> = only.map(|_| open.keys().cloned().collect());
        let own = cloud.store.own_links(names.as_deref()).await?;
        let missing = cloud.hub.compare(&open, &own);
        if only.is_some() {
            return Ok(());
        }
        // One that was missing before has ended while its end could not be stored.
        // All at once: the writer stores them with a few statements.
        let ended = missing.intersection(&self.missing);
        try_join_all(ended.map(|(vehicle, epoch)| cloud.store.disconnect(vehicle, *epoch))).await?;
        self.missing = missing;
        Ok(())
    }

    async fn look_at_records(&mut self, cloud: &Cloud) -> CloudResult<()> {
        let vehicles = cloud.hub.read_vehicles();
        self.arrivals.retain(|name, _| vehicles.contains(name));
        let mut arrived = BTreeSet::new();
        for name in vehicles {
            let last = cloud.store.arrived(&name).await?;
            // The first time, a reader may have looked before it.
            if self.arrivals.insert(name.clone(), last) != Some(last) {
                arrived.insert(name);
            }
        }
        cloud.hub.arrived_elsewhere(&arrived);
        Ok(())
    }
}

impl OwnLink {
    /// Returns the vehicle and the epoch.
    pub(crate) fn key(&self) -> (String, u64) {
        (self.vehicle.clone(), self.epoch)
    }
}
