//! The open connections, by network: their bounds, and which one ends for another.

use std::collections::{BTreeMap, HashMap};
use std::hash::{BuildHasher, RandomState};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use super::bounds::BoundCounts;
use super::network::ClientNetwork;

/// The open connections of a listener.
#[derive(Debug)]
pub(crate) struct OpenClients {
    groups: Mutex<ClientGroups>,
}

#[derive(Debug)]
struct ClientGroups {
    /// Number of connections so far.
    count: u64,
    strangers: ClientGroup,
    known: ClientGroup,
}

/// Connections with a bound of their own, by network and by age.
#[derive(Debug)]
struct ClientGroup {
    most: usize,
    /// True if a request in progress may end for a network with fewer connections.
    can_cut: bool,
    open: usize,
    networks: HashMap<ClientNetwork, BTreeMap<u64, Arc<ClientState>>>,
    counts: BoundCounts,
}

#[derive(Debug, Default)]
struct ClientState {
    /// Number of handshakes and requests in progress, and of control channels.
    work: AtomicUsize,
    /// True once the first record of TLS or the first request has come.
    has_begun: AtomicBool,
    is_cut: AtomicBool,
    end: Notify,
}

impl ClientState {
    fn is_idle(&self) -> bool {
        self.work.load(Ordering::Relaxed) == 0
    }

    fn is_silent(&self) -> bool {
        !self.has_begun.load(Ordering::Relaxed)
    }
}

impl ClientGroup {
    fn new(things: &'static str, most: usize, can_cut: bool) -> Self {
        let (networks, counts) = (HashMap::new(), BoundCounts::of(things));
        Self { most, can_cut, open: 0, networks, counts }
    }

    /// Adds a connection; returns whether there is room for it. At the bound, another one ends.
    fn add(&mut self, network: ClientNetwork, number: u64, state: &Arc<ClientState>) -> bool {
        if self.open >= self.most && !self.end_idle() && !self.cut_for(network) {
            self.counts.refused();
            return false;
        }
        self.networks.entry(network).or_default().insert(number, Arc::clone(state));
        self.open += 1;
        true
    }

    fn remove(&mut self, network: ClientNetwork, number: u64) -> Option<Arc<ClientState>> {
        let of_network = self.networks.get_mut(&network)?;
        let removed = of_network.remove(&number)?;
        if of_network.is_empty() {
            self.networks.remove(&network);
        }
        self.open -= 1;
        Some(removed)
    }

    /// Ends a connection of the network that has the most: a silent one, or the oldest one without
    /// a request; returns whether there is one.
    fn end_idle(&mut self) -> bool {
        let with_idle = self.networks.iter().filter(|(_, it)| it.values().any(|it| it.is_idle()));
        let Some((network, all)) = with_idle.max_by_key(|(_, it)| it.len()) else { return false };
        // Any silent one: if it were always the oldest, none of many vehicles that come at once
        // would live until its first record has arrived.
        let bounds = all.first_key_value().zip(all.last_key_value());
        let from = bounds.map_or(0, |((first, _), (last, _))| {
            first + RandomState::new().hash_one(last) % (last - first + 1)
        });
        let mut silent = all.range(from..).chain(all.range(..from)).filter(|it| it.1.is_silent());
        let ended = silent.next().or_else(|| all.iter().find(|(_, it)| it.is_idle()));
        let ended = ended.map(|(number, _)| (*network, *number));
        ended.is_some_and(|(network, number)| self.end(network, number, false))
    }

    /// Ends the newest connection of the network that has the most, for one of a network that has
    /// fewer: otherwise, a few could hold all places by requests that never end.
    fn cut_for(&mut self, network: ClientNetwork) -> bool {
        let own = self.networks.get(&network).map_or(0, BTreeMap::len);
        let most = self.networks.iter().max_by_key(|(_, it)| it.len());
        let most = most.filter(|(_, it)| self.can_cut && it.len() > own + 1);
        let newest = most.and_then(|(network, it)| Some((*network, *it.last_key_value()?.0)));
        newest.is_some_and(|(network, number)| self.end(network, number, true))
    }

    fn end(&mut self, network: ClientNetwork, number: u64, is_cut: bool) -> bool {
        let ended = self.remove(network, number);
        ended.is_some_and(|ended| {
            ended.is_cut.store(is_cut, Ordering::Relaxed);
            ended.end.notify_one();
            self.counts.ended();
            true
        })
    }
}

impl OpenClients {
    /// Creates the bounds of a listener, whose connections have the name `things` in the log.
    pub(crate) fn new(things: &'static str, known: usize, strangers: usize) -> Arc<Self> {
        let of_strangers = if known == 0 { things } else { "connections without a certificate" };
        let groups = Mutex::new(ClientGroups {
            count: 0,
            strangers: ClientGroup::new(of_strangers, strangers, true),
            known: ClientGroup::new(things, known, false),
        });
        Arc::new(Self { groups })
    }

    /// Counts a connection of a stranger. At a bound, another one ends for it; returns `None` if
    /// none can.
    pub(crate) fn open(self: &Arc<Self>, network: ClientNetwork) -> Option<OpenClient> {
        let (clients, state) = (Arc::clone(self), Arc::new(ClientState::default()));
        let mut groups = self.lock();
        groups.count += 1;
        let number = groups.count;
        let has_room = groups.strangers.add(network, number, &state);
        // A connection that is dropped takes the lock.
        drop(groups);
        has_room.then(|| OpenClient { clients, network, number, state, is_known: false })
    }

    fn lock(&self) -> MutexGuard<'_, ClientGroups> {
        self.groups.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// An open connection, until it is dropped.
#[derive(Debug)]
pub(crate) struct OpenClient {
    clients: Arc<OpenClients>,
    pub(crate) network: ClientNetwork,
    number: u64,
    state: Arc<ClientState>,
    is_known: bool,
}

impl OpenClient {
    /// Counts it among those with a certificate; returns whether there is room for it.
    pub(crate) fn become_known(&mut self) -> bool {
        let mut groups = self.clients.lock();
        groups.strangers.remove(self.network, self.number);
        self.is_known = groups.known.add(self.network, self.number, &self.state);
        self.is_known
    }

    /// Waits until the connection has to end, as others need its place.
    pub(crate) async fn ended(&self) {
        self.state.end.notified().await;
    }

    /// Returns whether it may end now: no request is being answered, or it ends anyway.
    pub(crate) fn can_end(&self) -> bool {
        self.state.is_idle() || self.state.is_cut.load(Ordering::Relaxed)
    }

    /// Counts a handshake or a request, or a connection that is used otherwise from now on.
    pub(crate) fn begin_work(&self) {
        self.state.has_begun.store(true, Ordering::Relaxed);
        self.state.work.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn end_work(&self) {
        self.state.work.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for OpenClient {
    fn drop(&mut self) {
        let mut groups = self.clients.lock();
        let group = if self.is_known { &mut groups.known } else { &mut groups.strangers };
        group.remove(self.network, self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(clients: &Arc<OpenClients>, address: &str) -> Option<OpenClient> {
        clients.open(ClientNetwork::of(address.parse().unwrap()))
    }

    fn has_place(client: &OpenClient) -> bool {
        let groups = client.clients.lock();
        let of_network = groups.strangers.networks.get(&client.network);
        of_network.is_some_and(|it| it.contains_key(&client.number))
    }

    #[test]
    fn with_all_places_taken_the_network_with_the_most_gives_one() {
        let clients = OpenClients::new("connections", 2, 5);
        // One network, as an IPv4 address in both forms is, and a /64 of IPv6.
        let many = ["10.0.0.1", "::ffff:10.0.0.1", "10.0.0.1", "10.0.0.1"];
        let many = many.map(|it| open(&clients, it).unwrap());
        // A request, one after its request, and two silent ones, of which the latter end first.
        many[0].begin_work();
        many[1].begin_work();
        many[1].end_work();
        let others = ["2001:db8::1", "10.0.0.3", "10.0.0.4"].map(|it| open(&clients, it).unwrap());
        others.iter().for_each(OpenClient::begin_work);
        assert_eq!([0, 1, 2, 3].map(|it| has_place(&many[it])), [true, true, false, false]);
        let more = open(&clients, "2001:db8::2:3").unwrap();
        more.begin_work();
        assert!(!has_place(&many[1]), "without a silent one, one without a request ends");
        assert!(open(&clients, "10.0.0.3").is_none(), "no other network has much more");
        // One that has more gives a request of its own to a network that has none.
        let _new = open(&clients, "2001:db8:0:1::1").unwrap();
        assert!(more.can_end() && !has_place(&more) && has_place(&others[0]));
        assert_eq!(clients.lock().strangers.counts.numbers(), (4, 1));
    }

    #[test]
    fn a_certificate_takes_a_connection_out_of_the_bound_of_strangers() {
        let clients = OpenClients::new("connections", 2, 1);
        let mut known = [1, 2, 3].map(|_| {
            let mut client = open(&clients, "10.0.0.1").unwrap();
            client.begin_work();
            let has_room = client.become_known();
            (client, has_room)
        });
        assert_eq!([0, 1, 2].map(|it| known[it].1), [true, true, false], "requests go on");
        assert!(!known[0].0.can_end());
        known[1].0.end_work();
        assert!(known[2].0.become_known(), "an idle one ends for it");
    }
}
