//! Clients by their networks: the bound of open connections of each, and the address that counts
//! for limits.

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, Ipv6Addr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::http::HeaderMap;
use tokio::sync::Notify;

use crate::bounds::BoundCounts;

/// The network of a client: an IPv4 address, or the first 64 bits of an IPv6 address, of which
/// one client can have all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct ClientNetwork(IpAddr);

impl ClientNetwork {
    pub(crate) fn of(address: IpAddr) -> Self {
        Self(match address.to_canonical() {
            IpAddr::V6(it) if !it.is_loopback() => {
                Ipv6Addr::from_bits(it.to_bits() & (u128::MAX << 64)).into()
            }
            address => address,
        })
    }

    /// Returns the network from which a proxy on this machine has got a request, as its header
    /// states. Only the last entry is from the proxy: clients can send all others.
    pub(crate) fn behind_proxy(self, headers: &HeaderMap) -> Self {
        let all = headers.get_all("x-forwarded-for").iter().next_back();
        let last = all.and_then(|it| it.to_str().ok()?.rsplit(',').next()?.trim().parse().ok());
        last.filter(|_| self.0.is_loopback()).map_or(self, Self::of)
    }
}

/// The open connections, by network.
#[derive(Debug)]
pub(crate) struct OpenClients {
    /// Maximum number of one network. A proxy on this machine has the connections of many clients.
    most_of_one: usize,
    all: Mutex<ConnectionsOfAll>,
    counts: BoundCounts,
}

type ConnectionsOfAll = HashMap<ClientNetwork, BTreeMap<u64, Arc<ClientState>>>;

#[derive(Debug, Default)]
struct ClientState {
    requests: AtomicUsize,
    end: Notify,
}

impl ClientState {
    fn is_idle(&self) -> bool {
        self.requests.load(Ordering::Relaxed) == 0
    }
}

impl OpenClients {
    pub(crate) fn new(things: &'static str, most_of_one: u32) -> Arc<Self> {
        let (all, counts) = (Mutex::default(), BoundCounts::of(things));
        Arc::new(Self { most_of_one: most_of_one as usize, all, counts })
    }

    /// Counts a connection, the `number`th one. At the bound of its network, the oldest one without
    /// a request ends for it; returns `None` if all of them have requests.
    pub(crate) fn open(self: &Arc<Self>, address: IpAddr, number: u64) -> Option<OpenClient> {
        let network = ClientNetwork::of(address);
        let mut all = self.lock();
        let of_network = all.entry(network).or_default();
        let is_full = of_network.len() >= self.most_of_one && !network.0.is_loopback();
        if is_full && !self.end_oldest_idle(of_network) {
            self.counts.refused();
            return None;
        }
        let state = Arc::new(ClientState::default());
        of_network.insert(number, Arc::clone(&state));
        Some(OpenClient { clients: Arc::clone(self), network, number, state })
    }

    /// Ends the oldest connection without a request of the network that has the most; returns
    /// whether there is one.
    pub(crate) fn end_one(&self) -> bool {
        let mut all = self.lock();
        let with_idle = all.values_mut().filter(|it| it.values().any(|it| it.is_idle()));
        with_idle.max_by_key(|it| it.len()).is_some_and(|it| self.end_oldest_idle(it))
    }

    /// Counts a connection that was refused, as all places are taken.
    pub(crate) fn refused(&self) {
        self.counts.refused();
    }

    fn end_oldest_idle(&self, of_network: &mut BTreeMap<u64, Arc<ClientState>>) -> bool {
        let oldest = of_network.iter().find(|(_, it)| it.is_idle()).map(|(number, _)| *number);
        let Some(ended) = oldest.and_then(|number| of_network.remove(&number)) else {
            return false;
        };
        ended.end.notify_one();
        self.counts.ended();
        true
    }

    fn lock(&self) -> MutexGuard<'_, ConnectionsOfAll> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// An open connection, until it is dropped.
#[derive(Debug)]
pub(crate) struct OpenClient {
    clients: Arc<OpenClients>,
    pub(crate) network: ClientNetwork,
    number: u64,
    state: Arc<ClientState>,
}

impl OpenClient {
    /// Waits until the connection has to end, as others need its place.
    pub(crate) async fn ended(&self) {
        self.state.end.notified().await;
    }

    /// Returns whether no request is being answered.
    pub(crate) fn is_idle(&self) -> bool {
        self.state.is_idle()
    }

    /// Counts a request, or a connection that is used otherwise from now on.
    pub(crate) fn begin_request(&self) {
        self.state.requests.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn end_request(&self) {
        self.state.requests.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for OpenClient {
    fn drop(&mut self) {
        let mut all = self.clients.lock();
        if let Some(of_network) = all.get_mut(&self.network) {
            of_network.remove(&self.number);
            if of_network.is_empty() {
                all.remove(&self.network);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn a_network_ends_its_own_idle_connections_and_has_a_bound() {
        let clients = OpenClients::new("connections", 2);
        let open = |text: &str, number| clients.open(address(text), number);
        let [one, _two] = [1, 2].map(|number| open("10.0.0.1", number).unwrap());
        one.begin_request();
        // The second one is the oldest without a request.
        let three = open("10.0.0.1", 3).unwrap();
        three.begin_request();
        assert!(open("10.0.0.1", 4).is_none(), "both have requests");
        assert_eq!(clients.counts.numbers(), (1, 1));
        assert!(open("10.0.0.2", 5).is_some(), "another network is not in question");
        one.end_request();
        assert!(open("::ffff:10.0.0.1", 6).is_some(), "the same address");
        let of_v6 = ["2001:db8::1", "2001:db8::2:3"].map(|it| open(it, it.len() as u64).unwrap());
        of_v6.iter().for_each(OpenClient::begin_request);
        assert!(open("2001:db8::ffff", 9).is_none(), "a /64 counts as one");
        assert!(open("2001:db8:0:1::1", 10).is_some());
        let of_proxy: Vec<_> = (20..30).map(|number| open("127.0.0.1", number)).collect();
        assert!(of_proxy.iter().all(Option::is_some), "a proxy has those of many clients");
    }

    #[test]
    fn with_all_places_taken_the_network_with_the_most_gives_one() {
        let clients = OpenClients::new("connections", 10);
        let many: Vec<_> = (0..3).map(|it| clients.open(address("10.0.0.1"), it)).collect();
        let _one = clients.open(address("10.0.0.2"), 3).unwrap();
        assert!((0..2).all(|_| clients.end_one()));
        assert!(many.iter().flatten().all(OpenClient::is_idle));
        assert_eq!(clients.lock()[&ClientNetwork::of(address("10.0.0.2"))].len(), 1);
        assert!(clients.end_one() && clients.end_one() && !clients.end_one());
        assert_eq!(clients.counts.numbers(), (4, 0));
    }

    #[test]
    fn only_the_last_entry_of_a_proxy_on_this_machine_counts() {
        let mut headers = HeaderMap::new();
        let network = |headers: &HeaderMap, peer: &str| {
            ClientNetwork::of(address(peer)).behind_proxy(headers).0
        };
        assert_eq!(network(&headers, "127.0.0.1"), address("127.0.0.1"));
        for value in ["10.0.0.9", "10.0.0.8, 10.0.0.7"] {
            headers.append("x-forwarded-for", HeaderValue::from_static(value));
        }
        assert_eq!(network(&headers, "127.0.0.1"), address("10.0.0.7"));
        assert_eq!(network(&headers, "::1"), address("10.0.0.7"));
        assert_eq!(network(&headers, "10.0.0.1"), address("10.0.0.1"), "no proxy of ours");
        headers.append("x-forwarded-for", HeaderValue::from_static("unknown"));
        assert_eq!(network(&headers, "127.0.0.1"), address("127.0.0.1"));
    }
}
