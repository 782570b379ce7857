//! Group commit: one task writes what vehicles send, that of many in one transaction. On the disk
//! it takes as long as that of one vehicle.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use sqlx::AnyPool;
use tokio::sync::{Mutex, mpsc, oneshot};

use super::{CloudStore, StoreChange, begin};
use crate::error::{CloudError, CloudResult};

/// Maximum number of writes in a transaction, so that other changes have their turn.
const GROUP_MAX: usize = 256;

/// A write of a vehicle.
pub(super) trait VehicleWrite: Send + Sync + 'static {
    type Done: Send;

    /// Applies the write. After an error of the vehicle, what it has changed so far is committed
    /// with the others: it checks before it changes what matters.
    fn apply(
        &self,
        change: &mut StoreChange<'_>,
    ) -> impl Future<Output = CloudResult<Self::Done>> + Send;
}

/// A write that waits for its transaction.
trait WaitingWrite: Send {
    /// Applies the write, and keeps its result until the commit.
    ///
    /// # Errors
    ///
    /// An error of the database, which affects all of the transaction.
    fn apply<'w>(&'w mut self, change: &'w mut StoreChange<'_>) -> Applied<'w>;

    /// Sends the result, once it is durable, or the failure of the transaction.
    fn finish(self: Box<Self>, failed: Option<CloudError>);
}

type Applied<'w> = Pin<Box<dyn Future<Output = CloudResult<()>> + Send + 'w>>;

struct Waiting<W: VehicleWrite> {
    write: W,
    result: Option<CloudResult<W::Done>>,
    reply: oneshot::Sender<CloudResult<W::Done>>,
}

impl<W: VehicleWrite> WaitingWrite for Waiting<W> {
    fn apply<'w>(&'w mut self, change: &'w mut StoreChange<'_>) -> Applied<'w> {
        Box::pin(async {
            match self.write.apply(change).await {
                Err(error) if error.is_internal() => Err(error),
                result => {
                    self.result = Some(result);
                    Ok(())
                }
            }
        })
    }

    fn finish(self: Box<Self>, failed: Option<CloudError>) {
        let result = failed.map(Err).or(self.result);
        // The connection may have ended meanwhile.
        let _ = self.reply.send(result.unwrap_or_else(|| Err(stopped())));
    }
}

/// The queue of the task that writes.
pub(super) struct WriteQueue(mpsc::Sender<Box<dyn WaitingWrite>>);

impl WriteQueue {
    /// Starts the task, which ends with the queue.
    pub(super) fn start(pool: AnyPool, turn: Arc<Mutex<&'static str>>) -> Self {
        let (queue, waiting) = mpsc::channel(GROUP_MAX);
        tokio::spawn(GroupWriter { pool, turn, waiting }.run());
        Self(queue)
    }
}

impl CloudStore {
    /// Writes with others; returns once the write is durable.
    pub(super) async fn write<W: VehicleWrite>(&self, write: W) -> CloudResult<W::Done> {
        let (reply, result) = oneshot::channel();
        let waiting = Waiting { write, result: None, reply };
        self.writes.0.send(Box::new(waiting)).await.map_err(|_| stopped())?;
        result.await.map_err(|_| stopped())?
    }
}

struct GroupWriter {
    pool: AnyPool,
    turn: Arc<Mutex<&'static str>>,
    waiting: mpsc::Receiver<Box<dyn WaitingWrite>>,
}

impl GroupWriter {
    async fn run(mut self) {
        let mut group = Vec::new();
        while self.waiting.recv_many(&mut group, GROUP_MAX).await > 0 {
            let failed = self.commit(&mut group).await.is_err();
            for mut write in group.drain(..) {
                // One that the database refuses must not take the others with it.
                let failed = match failed {
                    true => self.commit(std::slice::from_mut(&mut write)).await.err(),
                    false => None,
                };
                write.finish(failed);
            }
        }
    }

    async fn commit(&self, group: &mut [Box<dyn WaitingWrite>]) -> CloudResult<()> {
        let mut change = begin(&self.pool, &self.turn).await?;
        for write in group {
            write.apply(&mut change).await?;
        }
        change.commit().await
    }
}

fn stopped() -> CloudError {
    CloudError::busy("the cloud stops", "connect again")
}
