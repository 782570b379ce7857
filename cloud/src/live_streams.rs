//! Streams that people read as records come: a vehicle sends those at once, and collects the log
//! lines of others.
//!
//! A reader holds a lease of its streams, which its process renews in the database. The process
//! with the connection of the vehicle finds it there, and sends it to the vehicle. Without readers,
//! nothing is done for any vehicle.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use gleaner_fleet::STATUS_STREAM;
use gleaner_lambda::manifest::ItemName;
use tokio::sync::Notify;
use tokio::time::sleep;

use crate::error::CloudResult;
use crate::hub::Hub;
use crate::store::CloudStore;
use crate::ticks::ticks;

/// Interval at which leases are renewed: a third of their time.
const RENEW: Duration = Duration::from_secs(20);
/// Pause after which leases that could not be stored are stored again.
const RETRY: Duration = Duration::from_secs(2);
/// Least time between two times at which leases are stored.
const PAUSE: Duration = Duration::from_millis(200);

/// Time after a request for the status of a vehicle in which others are likely to follow.
const WATCHED: Duration = Duration::from_secs(10);
/// Number of vehicles whose statuses are leased at a time: each of them reports each second.
const WATCHED_MAX: usize = 64;

/// The streams that this process reads, and the number of readers of each.
#[derive(Debug, Default)]
pub(crate) struct LiveStreams {
    read: Mutex<BTreeMap<(String, String), usize>>,
    /// Vehicles whose statuses are read, until these times.
    watched: Mutex<BTreeMap<String, Instant>>,
    is_new: Notify,
}

/// A lease of streams of a vehicle, which is renewed until this is dropped.
pub(crate) struct TailReader {
    live_streams: Arc<LiveStreams>,
    keys: Vec<(String, String)>,
}

impl LiveStreams {
    /// Begins a lease of streams of a vehicle. What is no name of a stream has none.
    pub(crate) fn read(self: &Arc<Self>, vehicle: &str, streams: &[String]) -> TailReader {
        let is_stream = |name: &&String| match name.strip_prefix("lambdas/") {
            Some(id) => id.parse::<ItemName>().is_ok(),
            None => matches!(&***name, "events" | "orchestrator"),
        };
        // PostgreSQL would refuse the leases of all readers with such a name.
        let is_name = !vehicle.chars().any(char::is_control);
        let keys = streams.iter().filter(|name| is_name && is_stream(name));
        let keys: Vec<_> = keys.map(|stream| (vehicle.to_owned(), stream.clone())).collect();
        let mut read = self.lock();
        for key in &keys {
            *read.entry(key.clone()).or_default() += 1;
        }
        drop(read);
        self.is_new.notify_one();
        TailReader { live_streams: Arc::clone(self), keys }
    }

    /// Begins or extends a lease of the status of a vehicle, for a reader that asks repeatedly.
    pub(crate) fn watch(&self, vehicle: &str) {
        let mut watched = self.watched.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        watched.retain(|_, until| *until > now);
        let is_new = !watched.contains_key(vehicle);
        if is_new && (watched.len() >= WATCHED_MAX || vehicle.chars().any(char::is_control)) {
            return;
        }
        watched.insert(vehicle.to_owned(), now + WATCHED);
        drop(watched);
        if is_new {
            self.is_new.notify_one();
        }
    }

    /// Lets a vehicle that has connected learn of its readers here.
    pub(crate) fn connected(&self, vehicle: &str) {
        let first = (vehicle.to_owned(), String::new());
        let next = self.lock().range(first..).next().map(|((name, _), _)| name == vehicle);
        if next == Some(true) {
            self.is_new.notify_one();
        }
    }

    fn all(&self) -> Vec<(String, String)> {
        let now = Instant::now();
        let mut watched = self.watched.lock().unwrap_or_else(PoisonError::into_inner);
        watched.retain(|_, until| *until > now);
        let watched = watched.keys().map(|vehicle| (vehicle.clone(), STATUS_STREAM.to_owned()));
        let watched: Vec<_> = watched.collect();
        self.lock().keys().cloned().chain(watched).collect()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<(String, String), usize>> {
        self.read.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for TailReader {
    fn drop(&mut self) {
        let mut read = self.live_streams.lock();
        for key in &self.keys {
            if let Some(count) = read.get_mut(key) {
                *count -= 1;
                if *count == 0 {
                    read.remove(key);
                }
            }
        }
    }
}

/// Keeps the leases of readers of this process, for as long as it runs.
pub(crate) async fn keep(live_streams: &LiveStreams, store: &CloudStore, hub: &Hub) {
    let mut ticks = ticks(RENEW);
    // Those of an earlier process may be left.
    let mut has_leases = true;
    loop {
        let is_new = tokio::select! {
            _ = ticks.tick() => false,
            () = live_streams.is_new.notified() => true,
        };
        let read = live_streams.all();
        if read.is_empty() && !has_leases {
            continue;
        }
        let renewed = async {
            has_leases = store.extend_live_streams(&read).await? > 0;
            if is_new {
                hub.live_streams_changed();
            }
            deliver(store, hub).await
        };
        if let Err(error) = renewed.await {
            tracing::warn!(reason = error.reason(), "live log streams are delayed");
            sleep(RETRY).await;
            live_streams.is_new.notify_one();
        }
        // However many readers come, leases are stored a few times in a second.
        sleep(PAUSE).await;
    }
}

/// Hands the leases of all processes to the connections here.
pub(crate) async fn deliver(store: &CloudStore, hub: &Hub) -> CloudResult<()> {
    hub.tail(store.own_live_streams().await?);
    Ok(())
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;
    use crate::bus::Bus;

    #[tokio::test]
    async fn however_many_readers_come_leases_are_stored_a_few_times_in_a_second() {
        let (_folder, store) = crate::store::tests::store().await;
        let (queue, mut hints) = mpsc::channel(1000);
        let (live_streams, hub) =
            (Arc::new(LiveStreams::default()), Hub::new(Bus::of_queue(queue)));
        let begun = Instant::now();
        let readers = async {
            let mut readers = Vec::new();
            loop {
                readers.push(live_streams.read("car-7", &["events".to_owned()]));
                sleep(Duration::from_millis(1)).await;
            }
        };
        // Each time that leases of new readers are stored, other replicas get a hint.
        let stored = async {
            for _ in 0..4 {
                hints.recv().await.unwrap();
            }
        };
        tokio::select! {
            () = stored => {}
            () = keep(&live_streams, &store, &hub) => {}
            () = readers => {}
        }
        assert!(begun.elapsed() >= 3 * PAUSE, "{:?}", begun.elapsed());
    }

    #[test]
    fn statuses_of_some_vehicles_are_leased_and_no_name_that_cannot_be_stored() {
        let live_streams = LiveStreams::default();
        live_streams.watch("car\0");
        for number in 0..2 * WATCHED_MAX {
            live_streams.watch(&format!("car-{number}"));
            live_streams.watch("car-0");
        }
        let all = live_streams.all();
        assert_eq!(all.len(), WATCHED_MAX);
        assert!(all.contains(&("car-0".to_owned(), "status".to_owned())));
    }

    #[test]
    fn a_stream_is_read_until_its_last_reader_ends() {
        let live_streams = Arc::new(LiveStreams::default());
        let names =
            |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        let read = |streams: &[&str]| live_streams.read("car-7", &names(streams));
        let [first, second] = [read(&["events", "orchestrator"]), read(&["events"])];
        let odd = read(&["", "lambdas/", "lambdas/../x", "other", &"x".repeat(1 << 20)]);
        let of = |streams: &[&str]| {
            names(streams).into_iter().map(|it| ("car-7".to_owned(), it)).collect::<Vec<_>>()
        };
        assert_eq!(live_streams.all(), of(&["events", "orchestrator"]));
        drop((first, odd));
        assert_eq!(live_streams.all(), of(&["events"]));
        drop(second);
        assert_eq!(live_streams.all(), of(&[]));
        // The same stream twice, as readers of one stream name it.
        drop(read(&["lambdas/a", "lambdas/a"]));
        assert_eq!(live_streams.all(), of(&[]));
    }
}
