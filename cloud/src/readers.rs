//! Streams of records that people read, and files that are sent and received: bounded for each user
//! or vehicle, and for all.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use gleaner_fleet::listener::BoundCounts;
use gleaner_fleet::people::{Role, User};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::error::{CloudError, CloudResult};
use crate::store::CloudStore;

/// Maximum number of streams that are read at a time, by all users and by one; the latter also of
/// files, of which a vehicle may have fewer: some may be of connections that it has lost.
const READERS_MAX: usize = 64;
const OF_USER_MAX: usize = 16;
const OF_VEHICLE_MAX: usize = 8;

/// Interval at which the right to read is looked up: a token expires, and other replicas remove it.
const LOOK: Duration = Duration::from_millis(if cfg!(test) { 20 } else { 2000 });

/// The streams that are being read.
pub(crate) struct Readers {
    open: Mutex<HashMap<String, OpenReaders>>,
    things: &'static str,
    /// Maximum number of them.
    most: usize,
    counts: BoundCounts,
}

struct OpenReaders {
    count: usize,
    end: watch::Sender<()>,
}

/// The right to read a stream, until it is dropped.
pub(crate) struct ReaderSlot {
    readers: Arc<Readers>,
    user: String,
    ended: watch::Receiver<()>,
}

impl Readers {
    /// Creates the bound of streams or pages, which the log has under the name `things`.
    pub(crate) fn new(things: &'static str) -> Arc<Self> {
        Self::bounded(things, READERS_MAX)
    }

    pub(crate) fn bounded(things: &'static str, most: usize) -> Arc<Self> {
        let (open, counts) = (Mutex::default(), BoundCounts::of(things));
        Arc::new(Self { open, things, most, counts })
    }

    /// Begins to read a stream, or a transfer, for a user, unless there are too many already.
    pub(crate) fn open(self: &Arc<Self>, user: &str) -> CloudResult<ReaderSlot> {
        self.open_of(user, OF_USER_MAX)
    }

    pub(crate) fn open_of_vehicle(self: &Arc<Self>, name: &str) -> CloudResult<ReaderSlot> {
        self.open_of(&format!("vehicle {name}"), OF_VEHICLE_MAX)
    }

    fn open_of(self: &Arc<Self>, user: &str, of_one: usize) -> CloudResult<ReaderSlot> {
        let mut all = self.lock();
        let busy = |who: &str, most| {
            self.counts.refused();
            let message = format!("{who} has {most} {}, which is the limit", self.things);
            CloudError::busy(message, "end a `gleaner logs -f`, a page or a transfer, or wait")
        };
        // The more one has, the more it leaves to others: few that are slow do not hold all.
        let own = all.get(user).map_or(0, |it| it.count);
        let open = all.values().map(|it| it.count).sum();
        if open + own >= self.most {
            return Err(busy("the cloud", open));
        }
        let of_user = all
            .entry(user.to_owned())
            .or_insert_with(|| OpenReaders { count: 0, end: watch::Sender::new(()) });
        if of_user.count >= of_one {
            return Err(busy(user, of_one));
        }
        of_user.count += 1;
        let ended = of_user.end.subscribe();
        Ok(ReaderSlot { readers: Arc::clone(self), user: user.to_owned(), ended })
    }

    pub(crate) fn end(&self, user: &str) {
        if let Some(of_user) = self.lock().get(user) {
            of_user.end.send_replace(());
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, OpenReaders>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ReaderSlot {
    pub(crate) fn has_ended(&self) -> bool {
        self.ended.has_changed().unwrap_or(true)
    }

    pub(crate) async fn ended(&mut self) {
        // It stays changed, so that no later look misses it.
        while !self.has_ended() {
            let _ = self.ended.clone().changed().await;
        }
    }
}

pub(crate) struct ReaderToken {
    token: String,
    user: String,
    looked: Instant,
}

impl ReaderToken {
    /// Returns a token that was valid right now.
    pub(crate) fn new(token: &str, user: &User) -> Self {
        Self { token: token.to_owned(), user: user.name.clone(), looked: Instant::now() }
    }

    /// Returns whether the token still has the right to read, as far as it is time to look.
    pub(crate) async fn is_valid(&mut self, store: &CloudStore) -> CloudResult<bool> {
        if self.looked.elapsed() < LOOK {
            return Ok(true);
        }
        self.looked = Instant::now();
        let found = store.user(&self.token).await?;
        Ok(found.is_some_and(|it| it.user.name == self.user && it.user.role >= Role::Viewer))
    }

    /// Waits until the token has no right to read any more.
    pub(crate) async fn ended(&mut self, store: &CloudStore) {
        // Without the database, there is nothing to read meanwhile.
        while !matches!(self.is_valid(store).await, Ok(false)) {
            sleep_until(self.looked + LOOK).await;
        }
    }
}

/// Waits until it is time to look again whether a session may read.
pub(crate) async fn next_look() {
    tokio::time::sleep(LOOK).await;
}

impl Drop for ReaderSlot {
    fn drop(&mut self) {
        let mut all = self.readers.lock();
        if let Some(of_user) = all.get_mut(&self.user) {
            of_user.count -= 1;
            if of_user.count == 0 {
                all.remove(&self.user);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn streams_are_bounded_for_each_user_and_end_with_the_user() {
        let readers = Readers::new("streams");
        let mut of_ann: Vec<_> = (0..OF_USER_MAX).map(|_| readers.open("ann").unwrap()).collect();
        assert!(readers.open("ann").is_err());
        let _of_bob = readers.open("bob").unwrap();
        readers.end("ann");
        of_ann[0].ended().await;
        of_ann.pop();
        assert!(readers.open("ann").is_ok());
        let more: Vec<_> = (0..READERS_MAX).map(|user| readers.open(&user.to_string())).collect();
        assert_eq!(more.iter().filter(|it| it.is_ok()).count(), READERS_MAX - OF_USER_MAX);
        assert_eq!(readers.counts.numbers(), (0, 1 + OF_USER_MAX as u64));
        let few = Readers::bounded("files", 5);
        let open = ["ann", "ann", "ann", "ann", "bob", "bob", "eve"].map(|it| few.open(it));
        assert_eq!(open.map(|it| it.is_ok()), [true, true, true, false, true, false, true]);
    }
}
