//! Turns for work of which little is done at a time, shared fairly between networks.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::network::ClientNetwork;

/// A number of turns. A network may have all of them while no other one waits; then the networks
/// have the next ones in rotation, so that one with many connections delays others by one turn.
#[derive(Debug)]
pub struct FairTurns {
    turns: Arc<Semaphore>,
    /// Maximum number of those of one network that wait.
    waiting_max: usize,
    /// One connection of each network waits for the next turn, and all others of it for that.
    next: Mutex<HashMap<ClientNetwork, Arc<Semaphore>>>,
}

impl FairTurns {
    /// Creates turns, for which as many of a network may wait.
    pub fn new(turns: usize, waiting_max: usize) -> Self {
        let turns = Arc::new(Semaphore::new(turns));
        Self { turns, waiting_max, next: Mutex::default() }
    }

    /// Waits for a turn, which lasts until it is dropped; returns `None` if too many of the network
    /// wait for one.
    pub async fn take(&self, network: ClientNetwork) -> Option<OwnedSemaphorePermit> {
        if let Ok(turn) = Arc::clone(&self.turns).try_acquire_owned() {
            return Some(turn);
        }
        let next = {
            let mut all = self.next.lock().unwrap_or_else(PoisonError::into_inner);
            all.retain(|_, next| Arc::strong_count(next) > 1);
            let next = all.entry(network).or_insert_with(|| Arc::new(Semaphore::new(1)));
            if Arc::strong_count(next) > self.waiting_max {
                return None;
            }
            Arc::clone(next)
        };
        let _is_next = next.acquire().await.ok()?;
        Arc::clone(&self.turns).acquire_owned().await.ok()
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[tokio::test]
    async fn a_network_with_many_connections_delays_others_by_one_turn() {
        let turns = FairTurns::new(2, 3);
        let [many, few] = [1, 2].map(|last| ClientNetwork::of([10, 0, 0, last].into()));
        // With no other one waiting, a network has all turns.
        let (one, two) = (turns.take(many).await, turns.take(many).await);
        let mut waiting: Vec<_> = (0..3).map(|_| Box::pin(turns.take(many))).collect();
        assert!(waiting.iter_mut().all(|it| it.now_or_never().is_none()));
        assert!(turns.take(many).await.is_none(), "three of it wait");
        let mut other = Box::pin(turns.take(few));
        assert!((&mut other).now_or_never().is_none());
        drop((one, two));
        let first = waiting.remove(0).await.unwrap();
        assert!(waiting[0].as_mut().now_or_never().is_none());
        assert!(other.await.is_some(), "the second turn is for the other network");
        drop(first);
        for turn in waiting {
            assert!(turn.await.is_some());
        }
    }
}
