//! Connections of vehicles, by vehicle: presence, and the wishes that reach them at once.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};

use gleaner_fleet::GoAway;
use tokio::sync::watch;

use crate::store::now;

/// Latest time after which vehicles connect again when the server stops, in ms.
const RECONNECT_MS: u64 = 30_000;

/// Time after which a replaced connection may be opened again, in ms: two machines with the same
/// certificate would take turns without it.
const TAKEN_MS: u64 = 10_000;

/// Wishes for the connection of a vehicle.
#[derive(Debug, Clone, Default)]
pub(crate) struct LinkOrders {
    /// Number of changes of the wanted state since the connection began.
    pub(crate) changes: u64,
    /// The end of the connection.
    pub(crate) end: Option<GoAway>,
}

#[derive(Debug)]
struct OpenLink {
    epoch: u64,
    orders: watch::Sender<LinkOrders>,
}

/// All connections. A vehicle is online as long as its newest one is open: an older one that ends
/// later changes nothing.
#[derive(Debug, Default)]
pub(crate) struct Hub {
    state: Mutex<HubState>,
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
    fn lock(&self) -> MutexGuard<'_, HubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a connection, and ends an older one of the vehicle; `None` if there is a newer one.
    pub(crate) fn add(&self, name: &str, epoch: u64) -> Option<watch::Receiver<LinkOrders>> {
        let mut state = self.lock();
        if state.links.get(name).is_some_and(|link| link.epoch > epoch) {
            return None;
        }
        let end = state.is_stopping.then(stopping);
        let (orders, receiver) = watch::channel(LinkOrders { changes: 0, end });
        let before = state.links.insert(name.to_owned(), OpenLink { epoch, orders });
        if let Some(before) = before {
            before.end(TAKEN_MS, "the vehicle has a newer connection");
        }
        Some(receiver)
    }

    /// Removes a connection that has ended.
    pub(crate) fn remove(&self, name: &str, epoch: u64) {
        let mut state = self.lock();
        if state.links.get(name).is_some_and(|link| link.epoch == epoch) {
            state.links.remove(name);
        }
    }

    /// Ends the connection of a vehicle.
    pub(crate) fn end(&self, name: &str, reason: &str) {
        if let Some(link) = self.lock().links.remove(name) {
            link.end(60_000, reason);
        }
    }

    /// Lets connections send the wanted state again.
    pub(crate) fn wake(&self, names: &[String]) {
        let state = self.lock();
        for link in names.iter().filter_map(|name| state.links.get(name)) {
            link.orders.send_modify(|orders| orders.changes += 1);
        }
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

    /// Returns whether a vehicle is connected.
    pub(crate) fn is_online(&self, name: &str) -> bool {
        self.lock().links.contains_key(name)
    }

    /// Notes a sign of life.
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
        hub.remove("car-7", 1);
        assert!(hub.is_online("car-7"), "the end of the older one changes nothing");
        hub.remove("car-7", 2);
        assert!(!hub.is_online("car-7"));
    }
}
