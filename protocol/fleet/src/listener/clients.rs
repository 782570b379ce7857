//! The open connections, by network or certificate: their bounds, and which one ends for another.

use std::collections::{BTreeMap, HashMap};
use std::hash::{BuildHasher, Hash, RandomState};
use std::sync::atomic::{AtomicBool, AtomicIsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::bounds::BoundCounts;
use super::network::ClientNetwork;

/// Maximum number of connections with one certificate. A vehicle has one, and another one for
/// files; those that its link has lost stay open for a while.
const OF_ONE_MAX: usize = 16;
/// Time after its first record of TLS, or its first request, in which a connection ends only if no
/// other one can: the rest of its handshake is on the way. No test waits for it.
const BEGIN: Duration = Duration::from_secs(if cfg!(test) { 3600 } else { 1 });

/// More than the number of handshakes and requests of a connection.
const ALWAYS: isize = 1 << 30;

/// SHA-256 of a certificate.
type ClientDigest = [u8; 32];

/// The open connections of a listener.
#[derive(Debug)]
pub(crate) struct OpenClients {
    groups: Mutex<ClientGroups>,
}

#[derive(Debug)]
struct ClientGroups {
    /// Number of connections so far.
    count: u64,
    untrusted: ClientGroup<ClientNetwork>,
    known: ClientGroup<ClientDigest>,
}

/// Connections with a bound of their own, by client and by age.
#[derive(Debug)]
struct ClientGroup<C> {
    most: usize,
    /// Maximum number of those of one client.
    of_one: usize,
    /// True if of those in use the newest ends: it loses the least of a handshake.
    ends_newest: bool,
    open: usize,
    clients: HashMap<C, BTreeMap<u64, Arc<ClientState>>>,
    counts: BoundCounts,
}

#[derive(Debug, Default)]
struct ClientState {
    /// Number of handshakes and requests in progress; `ALWAYS` more for a control channel, and as
    /// much less for one that stays untrusted.
    work: AtomicIsize,
    /// Time of the first record of TLS, or of the first request.
    begun: OnceLock<Instant>,
    is_cut: AtomicBool,
    end: Notify,
}

impl ClientState {
    fn is_idle(&self) -> bool {
        self.work.load(Ordering::Relaxed) <= 0
    }

    fn can_be_cut(&self) -> bool {
        self.work.load(Ordering::Relaxed) < ALWAYS
    }

    fn is_silent(&self) -> bool {
        self.begun.get().is_none()
    }

    fn has_had_time(&self) -> bool {
        self.begun.get().is_some_and(|begun| begun.elapsed() >= BEGIN)
    }
}

impl<C: Copy + Eq + Hash> ClientGroup<C> {
    fn new(things: &'static str, most: usize, of_one: usize, ends_newest: bool) -> Self {
        let (clients, counts) = (HashMap::new(), BoundCounts::of(things));
        Self { most, of_one, ends_newest, open: 0, clients, counts }
    }

    /// Adds a connection; returns whether there is room for it. At a bound, another one ends: at
    /// that of one client, its own.
    fn add(&mut self, client: C, number: u64, state: &Arc<ClientState>) -> bool {
        let has_room = match self.count(client) < self.of_one {
            true => self.open < self.most || self.end_idle() || self.cut_for(client),
            false => self.end_idle_of(client) || self.cut(client),
        };
        if !has_room {
            self.counts.refused();
            return false;
        }
        self.clients.entry(client).or_default().insert(number, Arc::clone(state));
        self.open += 1;
        true
    }

    fn count(&self, client: C) -> usize {
        self.clients.get(&client).map_or(0, BTreeMap::len)
    }

    fn remove(&mut self, client: C, number: u64) -> Option<Arc<ClientState>> {
        let of_client = self.clients.get_mut(&client)?;
        let removed = of_client.remove(&number)?;
        if of_client.is_empty() {
            self.clients.remove(&client);
        }
        self.open -= 1;
        Some(removed)
    }

    /// Ends a connection of the client that has the most, of those with an idle one; returns
    /// whether there is one.
    fn end_idle(&mut self) -> bool {
        let with_idle = self.clients.iter().filter(|(_, it)| it.values().any(|it| it.is_idle()));
        let client = with_idle.max_by_key(|(_, it)| it.len()).map(|(client, _)| *client);
        client.is_some_and(|client| self.end_idle_of(client))
    }

    /// Ends an idle connection of a client: the oldest that has had time for a request, or else a
    /// silent one, whose first record may be on the way, or else the oldest.
    fn end_idle_of(&mut self, client: C) -> bool {
        let Some(all) = self.clients.get(&client) else { return false };
        // Any silent one: if it were always the oldest, none of many vehicles that come at once
        // would live until its first record has arrived.
        let bounds = all.first_key_value().zip(all.last_key_value());
        let from = bounds.map_or(0, |((first, _), (last, _))| {
            first + RandomState::new().hash_one(last) % (last - first + 1)
        });
        let mut silent = all.range(from..).chain(all.range(..from)).filter(|it| it.1.is_silent());
        let oldest = |has_had_time: bool| {
            all.iter().find(|(_, it)| it.is_idle() && (it.has_had_time() || !has_had_time))
        };
        let ended = oldest(true).or_else(|| silent.next()).or_else(|| oldest(false));
        let ended = ended.map(|(number, _)| *number);
        ended.is_some_and(|number| self.end(client, number, false))
    }

    /// Ends a connection of the client that has the most, for one of a client that has fewer:
    /// otherwise, a few could hold all places by requests that never end.
    fn cut_for(&mut self, client: C) -> bool {
        let own = self.count(client);
        let more = self.clients.iter().filter(|(_, it)| it.len() > own + 1);
        let more = more.filter(|(_, it)| it.values().any(|it| it.can_be_cut()));
        let most = more.max_by_key(|(_, it)| it.len()).map(|(client, _)| *client);
        most.is_some_and(|client| self.cut(client))
    }

    fn cut(&mut self, client: C) -> bool {
        let all = self.clients.get(&client).into_iter().flatten();
        let mut all = all.filter(|(_, it)| it.can_be_cut()).map(|(number, _)| *number);
        let cut = if self.ends_newest { all.next_back() } else { all.next() };
        cut.is_some_and(|number| self.end(client, number, true))
    }

    fn end(&mut self, client: C, number: u64, is_cut: bool) -> bool {
        let ended = self.remove(client, number);
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
    pub(crate) fn new(things: &'static str, known: usize, untrusted: usize) -> Arc<Self> {
        let of_untrusted = if known == 0 { things } else { "connections without a certificate" };
        let groups = Mutex::new(ClientGroups {
            count: 0,
            // With TLS, untrusted peers are in use only for a handshake.
            untrusted: ClientGroup::new(of_untrusted, untrusted, usize::MAX, known > 0),
            known: ClientGroup::new(things, known, OF_ONE_MAX, false),
        });
        Arc::new(Self { groups })
    }

    /// Counts a connection of an untrusted peer. At a bound, another one ends for it; returns
    /// `None` if none can.
    pub(crate) fn open(self: &Arc<Self>, network: ClientNetwork) -> Option<OpenClient> {
        let (clients, state) = (Arc::clone(self), Arc::new(ClientState::default()));
        let mut groups = self.lock();
        groups.count += 1;
        let number = groups.count;
        let has_room = groups.untrusted.add(network, number, &state);
        // A connection that is dropped takes the lock.
        drop(groups);
        has_room.then(|| OpenClient { clients, network, number, state, known: None })
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
    known: Option<ClientDigest>,
}

impl OpenClient {
    /// Counts it among those with a certificate; returns whether there is room for it.
    pub(crate) fn become_known(&mut self, certificate: ClientDigest) -> bool {
        let mut groups = self.clients.lock();
        groups.untrusted.remove(self.network, self.number);
        let has_room = groups.known.add(certificate, self.number, &self.state);
        self.known = has_room.then_some(certificate);
        has_room
    }

    /// Lets it end for others from now on, whatever it does: untrusted peers could hold all places
    /// by requests that never end.
    pub(crate) fn stay_untrusted(&self) {
        self.state.work.fetch_sub(ALWAYS, Ordering::Relaxed);
    }

    /// Counts it as in use until it ends.
    pub(crate) fn keep(&self) {
        self.state.work.fetch_add(ALWAYS, Ordering::Relaxed);
    }

    /// Waits until the connection has to end, as others need its place.
    pub(crate) async fn ended(&self) {
        self.state.end.notified().await;
    }

    /// Returns whether it may end now: no request is being answered, or it ends anyway.
    pub(crate) fn can_end(&self) -> bool {
        self.state.is_idle() || self.state.is_cut.load(Ordering::Relaxed)
    }

    /// Counts a handshake or a request.
    pub(crate) fn begin_work(&self) {
        self.state.begun.get_or_init(Instant::now);
        self.state.work.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn end_work(&self) {
        self.state.work.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for OpenClient {
    fn drop(&mut self) {
        let mut groups = self.clients.lock();
        match self.known {
            Some(certificate) => groups.known.remove(certificate, self.number),
            None => groups.untrusted.remove(self.network, self.number),
        };
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
        let of_network = groups.untrusted.clients.get(&client.network);
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
        // One that has more gives its newest handshake to a network that has none.
        let _new = open(&clients, "2001:db8:0:1::1").unwrap();
        assert!(more.can_end() && !has_place(&more) && has_place(&others[0]));
        assert_eq!(clients.lock().untrusted.counts.numbers(), (4, 1));
    }

    #[test]
    fn strangers_that_have_begun_end_for_silent_ones_and_a_vehicle_of_their_address_does_not() {
        let (clients, address) = (OpenClients::new("connections", 2, 20), "10.0.0.1");
        let silent =
            |count| -> Vec<_> { (0..count).map(|_| open(&clients, address).unwrap()).collect() };
        let untrusted = silent(20);
        for (number, peer) in untrusted.iter().enumerate() {
            peer.state.begun.set(Instant::now() - 2 * BEGIN).unwrap();
            if number % 2 == 0 {
                // Its request never ends.
                peer.stay_untrusted();
                peer.begin_work();
            }
        }
        let mut vehicle = open(&clients, address).unwrap();
        assert_eq!([0, 1].map(|it| has_place(&untrusted[it])), [false, true], "the oldest ends");
        let mut flood = silent(18);
        assert!(has_place(&vehicle), "its first record is on the way");
        vehicle.begin_work();
        flood.extend(silent(100));
        assert!(has_place(&vehicle) && !untrusted.iter().any(has_place));
        assert!(vehicle.become_known([1; 32]));
        vehicle.end_work();
        flood.extend(silent(100));
        assert_eq!(clients.lock().known.open, 1);
    }

    #[test]
    fn a_vehicle_with_many_requests_takes_no_more_places_and_gives_some_to_others() {
        // Known ones do not count among the untrusted peers, of which there is one at a time.
        let clients = OpenClients::new("connections", OF_ONE_MAX + 2, 1);
        let known = |certificate| {
            let mut client = open(&clients, "10.0.0.1").unwrap();
            client.begin_work();
            client.become_known([certificate; 32]).then_some(client).unwrap()
        };
        let mut many: Vec<_> = (0..OF_ONE_MAX).map(|_| known(1)).collect();
        many[0].keep();
        many[5].end_work();
        many.extend([1, 1].map(known));
        let ended = |at: &[usize]| at.iter().all(|at| many[*at].can_end());
        assert!(ended(&[5, 1]) && !ended(&[2]), "its idle one, and the oldest but its channel");
        let _others = [2, 3, 4].map(known);
        assert!(ended(&[2]) && !ended(&[0]));
        assert_eq!(clients.lock().known.counts.numbers(), (3, 0));
    }
}
