//! Group commit: one task writes what vehicles send, that of many in one transaction and by few
//! statements. On the disk it takes as long as that of one vehicle.

use std::any::{Any, TypeId};
use std::sync::Arc;
use std::time::Instant;

use futures_util::future::BoxFuture;
use tokio::sync::{Mutex, mpsc, oneshot};

use super::counting::GroupVehicles;
use super::{CloudStore, StoreChange, begin};
use crate::counts::COUNTS;
use crate::error::{CloudError, CloudResult};
use crate::sqlx::AnyPool;

/// Maximum number of writes in a transaction, so that other changes have their turn. With 1,024,
/// 10,000 vehicles stored no more in a second.
const GROUP_MAX: usize = 256;

/// A kind of writes, of which those of a group are applied together.
pub(super) trait VehicleWrite: Send + Sized + 'static {
    type Done: Send;

    /// Place of the kind among all in a transaction: those with a lower one are applied first.
    const TURN: u8;

    /// Applies the writes of a group, and sets their results. An error of a vehicle is the result
    /// of its write.
    /// Fails with the database, for all of the group.
    fn apply(
        change: &mut StoreChange<'_>,
        vehicles: &mut GroupVehicles,
        writes: &mut [&mut Waiting<Self>],
    ) -> impl Future<Output = CloudResult<()>> + Send;
}

pub(super) struct Waiting<W: VehicleWrite> {
    pub(super) vehicle: String,
    pub(super) write: W,
    /// The result, which is sent once it is durable. Without one, the write has failed with all of
    /// its transaction.
    pub(super) result: Option<CloudResult<W::Done>>,
    reply: oneshot::Sender<CloudResult<W::Done>>,
}

type ApplyWrites = for<'w> fn(
    &'w mut StoreChange<'_>,
    &'w mut GroupVehicles,
    &'w mut [&mut QueuedWrite],
) -> BoxFuture<'w, CloudResult<()>>;

/// A [`Waiting`] of any kind.
trait AnyWaiting: Any + Send {
    fn vehicle(&self) -> &str;

    /// Returns the place of its kind in the transaction, and the kind.
    fn kind(&self) -> (u8, TypeId);

    /// Returns the function that applies writes of its kind.
    fn apply(&self) -> ApplyWrites;

    /// Sends the result, or the failure of the transaction.
    fn finish(self: Box<Self>, failed: Option<CloudError>);
}

type QueuedWrite = Box<dyn AnyWaiting>;

impl<W: VehicleWrite> AnyWaiting for Waiting<W> {
    fn vehicle(&self) -> &str {
        &self.vehicle
    }

    fn kind(&self) -> (u8, TypeId) {
        (W::TURN, TypeId::of::<W>())
    }

    fn apply(&self) -> ApplyWrites {
        |change, vehicles, writes| {
            let own = writes.iter_mut().filter_map(|write| {
                let write: &mut dyn Any = &mut ***write;
                write.downcast_mut::<Self>()
            });
            let mut own: Vec<_> = own.collect();
            Box::pin(async move { W::apply(change, vehicles, &mut own).await })
        }
    }

    fn finish(self: Box<Self>, failed: Option<CloudError>) {
        let result = failed.map(Err).or(self.result);
        // The connection may have ended meanwhile.
        let _ = self.reply.send(result.unwrap_or_else(|| Err(stopped())));
    }
}

pub(super) struct WriteQueue(mpsc::Sender<QueuedWrite>);

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
    pub(super) async fn write<W: VehicleWrite>(
        &self,
        vehicle: &str,
        write: W,
    ) -> CloudResult<W::Done> {
        let (reply, result) = oneshot::channel();
        let vehicle = vehicle.to_owned();
        let waiting = Box::new(Waiting { vehicle, write, result: None, reply });
        self.writes.0.send(waiting).await.map_err(|_| stopped())?;
        result.await.map_err(|_| stopped())?
    }
}

struct GroupWriter {
    pool: AnyPool,
    turn: Arc<Mutex<&'static str>>,
    waiting: mpsc::Receiver<QueuedWrite>,
}

impl GroupWriter {
    async fn run(mut self) {
        let mut group = Vec::new();
        while self.waiting.recv_many(&mut group, GROUP_MAX).await > 0 {
            let start = Instant::now();
            let failed = self.commit(&mut group).await.is_err();
            COUNTS.writes.add(1);
            COUNTS.write_us.add(start.elapsed().as_micros() as u64);
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

    /// Applies the writes of a group, one kind after the other.
    /// Fails with the database, for all of the group.
    async fn commit(&self, group: &mut [QueuedWrite]) -> CloudResult<()> {
        let mut change = begin(&self.pool, &self.turn).await?;
        let names: Vec<_> = group.iter().map(|write| write.vehicle()).collect();
        let mut vehicles = change.group_vehicles(&names).await?;
        let mut writes: Vec<_> = group.iter_mut().collect();
        writes.sort_by_key(|write| write.kind());
        for writes in writes.chunk_by_mut(|one, next| one.kind() == next.kind()) {
            let apply = writes[0].apply();
            apply(&mut change, &mut vehicles, writes).await?;
        }
        change.commit().await
    }
}

pub(super) fn stopped() -> CloudError {
    CloudError::busy("the cloud stops", "connect again")
}
