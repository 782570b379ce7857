//! Connections of vehicles, by vehicle: presence, and the wishes that reach them at once.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_fleet::GoAway;
use tokio::sync::watch;

use crate::bus::{Bus, Hint};
use crate::store::{OwnLink, VehicleTail, now};

/// Latest time after which vehicles connect again when the server stops, in ms.
const RECONNECT_MS: u64 = 30_000;

/// Time after which a connection that was replaced or revoked may be opened again, in ms: two
/// machines with the same certificate would take turns without it.
const TAKEN_MS: u64 = 10_000;

/// Wishes for the connection of a vehicle.
#[derive(Debug, Clone, Default)]
pub(crate) struct PendingRequests {
    /// Number of changes of the desired state since the connection began.
    pub(crate) changes: u64,
    /// Number of the desired state that another replica has made, or an older one.
    pub(crate) generation: u64,
    /// The streams that people read.
    pub(crate) tail: Arc<VehicleTail>,
    pub(crate) end: Option<GoAway>,
}

#[derive(Debug)]
struct OpenLink {
    epoch: u64,
    orders: watch::Sender<PendingRequests>,
}

/// All connections to this process: of each vehicle the newest one. An older one that ends later
/// changes nothing.
#[derive(Debug, Default)]
pub(crate) struct Hub {
    state: Mutex<HubState>,
    /// Other replicas, which learn of changes here.
    bus: Bus,
}

#[derive(Debug, Default)]
struct HubState {
    links: HashMap<String, OpenLink>,
    /// Readers that wait for records of a vehicle.
    arrivals: HashMap<String, watch::Sender<()>>,
    /// Last signs of life that are not stored yet.
    seen: BTreeMap<String, i64>,
    is_stopping: bool,
}

impl Hub {
    pub(crate) fn new(bus: Bus) -> Self {
        Self { state: Mutex::default(), bus }
    }

    fn lock(&self) -> MutexGuard<'_, HubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a connection, and ends an older one of the vehicle; `None` if there is a newer one.
    pub(crate) fn add(&self, name: &str, epoch: u64) -> Option<watch::Receiver<PendingRequests>> {
        let mut state = self.lock();
        if state.links.get(name).is_some_and(|link| link.epoch > epoch) {
            return None;
        }
        let end = state.is_stopping.then(stopping);
        let (orders, receiver) =
            watch::channel(PendingRequests { end, ..PendingRequests::default() });
        let before = state.links.insert(name.to_owned(), OpenLink { epoch, orders });
        if let Some(before) = before {
            before.end(TAKEN_MS, "the vehicle has a newer connection");
        }
        drop(state);
        self.bus.changed(&[name.to_owned()]);
        Some(receiver)
    }

    /// Removes a connection that has ended; returns whether the database should have its end.
    pub(crate) fn remove(&self, name: &str, epoch: u64) -> bool {
        let mut state = self.lock();
        let is_newest = state.links.get(name).is_some_and(|link| link.epoch == epoch);
        if is_newest {
            state.links.remove(name);
        }
        // With the process, all its vehicles are offline.
        is_newest && !state.is_stopping
    }

    pub(crate) fn end(&self, name: &str, reason: &str) {
        if let Some(link) = self.lock().links.remove(name) {
            link.end(TAKEN_MS, reason);
        }
        self.bus.changed(&[name.to_owned()]);
    }

    /// Lets connections send the desired state again.
    pub(crate) fn wake(&self, names: &[String]) {
        let state = self.lock();
        for link in names.iter().filter_map(|name| state.links.get(name)) {
            link.orders.send_modify(|orders| orders.changes += 1);
        }
        drop(state);
        self.bus.changed(names);
    }

    /// Returns the epochs of the connections by vehicle: of all, or of those in `only`.
    pub(crate) fn open_links(&self, only: Option<&[String]>) -> HashMap<String, u64> {
        let state = self.lock();
        match only {
            None => state.links.iter().map(|(name, link)| (name.clone(), link.epoch)).collect(),
            Some(names) => {
                let link = |name: &String| Some((name.clone(), state.links.get(name)?.epoch));
                names.iter().filter_map(link).collect()
            }
        }
    }

    /// Compares connections that were `open` with those that count by the database: ends others,
    /// and wakes those with a higher desired state. Returns those of the database that are absent.
    pub(crate) fn compare(
        &self,
        open: &HashMap<String, u64>,
        own: &[OwnLink],
    ) -> BTreeSet<(String, u64)> {
        let counting: HashMap<_, _> = own.iter().map(|it| (&*it.vehicle, it)).collect();
        let mut state = self.lock();
        for (name, epoch) in open {
            let Some(link) = state.links.get(name).filter(|link| link.epoch == *epoch) else {
                continue;
            };
            match counting.get(&**name).filter(|it| it.epoch == *epoch) {
                Some(own) => {
                    link.orders.send_if_modified(|orders| {
                        let is_higher = own.generation > orders.generation;
                        orders.generation = orders.generation.max(own.generation);
                        is_higher
                    });
                }
                None => {
                    link.end(TAKEN_MS, "the vehicle has a newer connection, or was revoked");
                    state.links.remove(name);
                }
            }
        }
        let is_missing = |own: &&OwnLink| {
            state.links.get(&own.vehicle).is_none_or(|link| link.epoch < own.epoch)
        };
        own.iter().filter(is_missing).map(OwnLink::key).collect()
    }

    /// Hands leases of streams to the connections of their vehicles.
    pub(crate) fn tail(&self, live_streams: BTreeMap<String, VehicleTail>) {
        let state = self.lock();
        for (name, tail) in live_streams {
            let Some(link) = state.links.get(&name) else { continue };
            link.orders.send_if_modified(|orders| {
                let is_other = *orders.tail != tail;
                if is_other {
                    orders.tail = Arc::new(tail);
                }
                is_other
            });
        }
    }

    /// Lets other replicas look at the leases of streams.
    pub(crate) fn live_streams_changed(&self) {
        self.bus.send(|| Hint::LiveStreams);
    }

    /// Ends all connections and all readers, those of the future, too.
    pub(crate) fn stop(&self) {
        let mut state = self.lock();
        state.is_stopping = true;
        state.arrivals.clear();
        for link in state.links.values() {
            link.orders.send_modify(|orders| orders.end = Some(stopping()));
        }
    }

    pub(crate) fn saw(&self, name: &str) {
        let mut state = self.lock();
        match state.seen.get_mut(name) {
            Some(time) => *time = now(),
            None => drop(state.seen.insert(name.to_owned(), now())),
        }
    }

    /// Returns the signs of life since the last call.
    pub(crate) fn take_seen(&self) -> BTreeMap<String, i64> {
        std::mem::take(&mut self.lock().seen)
    }

    /// Returns a channel that changes with each arrival of records of a vehicle, and closes when
    /// the server stops.
    pub(crate) fn arrivals(&self, name: &str) -> watch::Receiver<()> {
        let mut state = self.lock();
        state.arrivals.retain(|_, sender| sender.receiver_count() > 0);
        if state.is_stopping {
            return watch::channel(()).1;
        }
        let sender = state.arrivals.entry(name.to_owned());
        sender.or_insert_with(|| watch::channel(()).0).subscribe()
    }

    /// Wakes the readers that wait for records of a vehicle.
    pub(crate) fn arrived(&self, name: &str) {
        if let Some(sender) = self.lock().arrivals.get(name) {
            sender.send_replace(());
        }
        self.bus.send(|| Hint::Records(name.to_owned()));
    }

    /// Wakes readers here of records that other replicas have received.
    pub(crate) fn arrived_elsewhere(&self, names: &BTreeSet<String>) {
        let state = self.lock();
        for sender in names.iter().filter_map(|name| state.arrivals.get(name)) {
            sender.send_replace(());
        }
    }

    pub(crate) fn read_vehicles(&self) -> BTreeSet<String> {
        let mut state = self.lock();
        state.arrivals.retain(|_, sender| sender.receiver_count() > 0);
        state.arrivals.keys().cloned().collect()
    }
}

impl OpenLink {
    fn end(&self, after_ms: u64, reason: &str) {
        let end = GoAway { after_ms, reason: reason.to_owned() };
        self.orders.send_modify(|orders| orders.end = Some(end));
    }
}

/// Returns the end of a connection to a server that stops: each vehicle comes back at another time.
fn stopping() -> GoAway {
    let after_ms = getrandom::u64().map_or(RECONNECT_MS, |random| random % RECONNECT_MS);
    GoAway { after_ms, reason: "the cloud stops".to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_newest_connection_counts() {
        let hub = Hub::default();
        let first = hub.add("car-7", 1).unwrap();
        let second = hub.add("car-7", 2).unwrap();
        assert!(first.borrow().end.is_some() && second.borrow().end.is_none());
        assert!(hub.add("car-7", 1).is_none());
        assert!(!hub.remove("car-7", 1), "the end of the older one changes nothing");
        assert!(hub.remove("car-7", 2));
        assert!(hub.open_links(None).is_empty());
    }

    #[test]
    fn what_other_replicas_have_changed_reaches_the_connections_here() {
        let hub = Hub::default();
        let mut links = ["a", "b", "c"].map(|name| hub.add(name, 3).unwrap());
        let open = hub.open_links(None);
        let own = |vehicle: &str, epoch, generation| OwnLink {
            vehicle: vehicle.to_owned(),
            epoch,
            generation,
        };
        // Of `b`, another replica has the connection; that of `d` begins during the look, and the
        // end of `e` was not stored.
        let _later = hub.add("d", 1).unwrap();
        let counting = [own("a", 3, 7), own("c", 4, 7), own("e", 1, 1)];
        let missing = hub.compare(&open, &counting);
        let [a, b, c] = &mut links;
        let (orders, is_changed) = (a.borrow().clone(), a.has_changed().unwrap());
        assert!(is_changed && orders.generation == 7 && orders.end.is_none());
        assert!(b.borrow().end.is_some() && c.borrow().end.is_some());
        assert_eq!(missing, [("c".to_owned(), 4), ("e".to_owned(), 1)].into());
        assert_eq!(hub.open_links(None).len(), 2);
        a.mark_unchanged();
        hub.compare(&hub.open_links(None), &[own("a", 3, 7), own("d", 1, 1)]);
        assert!(!a.has_changed().unwrap(), "nothing is new");
    }
}
