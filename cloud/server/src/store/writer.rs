//! Group commit: one task writes what vehicles send, that of many in one transaction and by few
//! statements. On the disk it takes as long as that of one vehicle.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{Mutex, mpsc, oneshot};

use super::append::AppendWrite;
use super::links::{ConnectWrite, ReportWrite};
use super::replicas::DisconnectWrite;
use super::{CloudStore, StoreChange, begin};
use crate::counts::COUNTS;
use crate::error::{CloudError, CloudResult};
use crate::sqlx::AnyPool;

/// Maximum number of writes in a transaction, so that other changes have their turn. With 1,024,
/// 10,000 vehicles stored no more in a second.
const GROUP_MAX: usize = 256;

pub(super) trait VehicleWrite: Sized {
    type Done;

    const WAITING: fn(Waiting<Self>) -> WaitingWrite;
}

pub(super) struct Waiting<W: VehicleWrite> {
    pub(super) vehicle: String,
    pub(super) write: W,
    /// The result, which is sent once it is durable. Without one, the write has failed with all of
    /// its transaction.
    pub(super) result: Option<CloudResult<W::Done>>,
    reply: oneshot::Sender<CloudResult<W::Done>>,
}

pub(super) enum WaitingWrite {
    Connect(Waiting<ConnectWrite>),
    Report(Waiting<ReportWrite>),
    Append(Waiting<AppendWrite>),
    Disconnect(Waiting<DisconnectWrite>),
}

/// The vehicles of a group as they are stored, apart from what the group has changed already.
pub(super) type GroupVehicles = HashMap<String, GroupVehicle>;

typed! {
    /// Values of a vehicle that its writes are checked against.
    #[derive(Debug, Clone)]
    pub(super) struct GroupVehicle {
        name: String,
        pub(super) epoch: i64,
        pub(super) is_revoked: bool,
        pub(super) arrived: i64,
        pub(super) labels: String,
        pub(super) digest: String,
        pub(super) generation: i64,
        /// The newest wanted state that was sent to it.
        pub(super) offered: i64,
        pub(super) is_ahead: i64,
        /// The boot of its machine, and the one before.
        pub(super) boot: String,
        pub(super) former_boot: String,
        /// Number of times that a former boot has come back, up to [`DOUBLE`].
        pub(super) is_double: i64,
    }
}

/// Number of times after which two machines have one identity: once, a failover may be the reason.
pub(super) const DOUBLE: i64 = 2;

impl GroupVehicle {
    /// Notes the boot of a machine that connects; returns whether it is let in. The former boot
    /// comes back again and again only if two machines have the identity: then the other one goes
    /// on alone.
    pub(super) fn admits(&mut self, boot: &str) -> bool {
        if boot.is_empty() || boot == self.boot {
            return true;
        }
        if boot == self.former_boot {
            self.is_double = (self.is_double + 1).min(DOUBLE);
            if self.is_double == DOUBLE {
                return false;
            }
        }
        self.former_boot = std::mem::replace(&mut self.boot, boot.to_owned());
        true
    }
}

impl WaitingWrite {
    fn vehicle(&self) -> &str {
        match self {
            Self::Connect(waiting) => &waiting.vehicle,
            Self::Report(waiting) => &waiting.vehicle,
            Self::Append(waiting) => &waiting.vehicle,
            Self::Disconnect(waiting) => &waiting.vehicle,
        }
    }

    /// Sends the result, or the failure of the transaction.
    fn finish(self, failed: Option<CloudError>) {
        match self {
            Self::Connect(waiting) => waiting.finish(failed),
            Self::Report(waiting) => waiting.finish(failed),
            Self::Append(waiting) => waiting.finish(failed),
            Self::Disconnect(waiting) => waiting.finish(failed),
        }
    }
}

impl<W: VehicleWrite> Waiting<W> {
    fn finish(self, failed: Option<CloudError>) {
        let result = failed.map(Err).or(self.result);
        // The connection may have ended meanwhile.
        let _ = self.reply.send(result.unwrap_or_else(|| Err(stopped())));
    }
}

pub(super) struct WriteQueue(mpsc::Sender<WaitingWrite>);

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
        let waiting = (W::WAITING)(Waiting { vehicle, write, result: None, reply });
        self.writes.0.send(waiting).await.map_err(|_| stopped())?;
        result.await.map_err(|_| stopped())?
    }
}

struct GroupWriter {
    pool: AnyPool,
    turn: Arc<Mutex<&'static str>>,
    waiting: mpsc::Receiver<WaitingWrite>,
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

    /// Applies the writes of a group: the beginnings of connections first, as older connections of
    /// their vehicles do not count any more. An error of a vehicle is the result of its write.
    /// Fails with the database, for all of the group.
    async fn commit(&self, group: &mut [WaitingWrite]) -> CloudResult<()> {
        let mut change = begin(&self.pool, &self.turn).await?;
        let mut vehicles = change.group_vehicles(group).await?;
        let (mut connects, mut ends) = (Vec::new(), Vec::new());
        let (mut reports, mut appends) = (Vec::new(), Vec::new());
        for write in group {
            match write {
                WaitingWrite::Connect(waiting) => connects.push(waiting),
                WaitingWrite::Report(waiting) => reports.push(waiting),
                WaitingWrite::Append(waiting) => appends.push(waiting),
                WaitingWrite::Disconnect(waiting) => ends.push(waiting),
            }
        }
        change.connect_all(&mut vehicles, &mut connects).await?;
        change.report_all(&mut vehicles, &mut reports).await?;
        change.append_all(&mut vehicles, &mut appends).await?;
        change.disconnect_all(&mut vehicles, &mut ends).await?;
        change.commit().await
    }
}

impl StoreChange<'_> {
    async fn group_vehicles(&mut self, group: &[WaitingWrite]) -> CloudResult<GroupVehicles> {
        let names: Vec<_> = group.iter().map(WaitingWrite::vehicle).collect();
        let rows: Vec<GroupVehicle> = rows_in!(self;
            "SELECT name, labels, digest, boot, former_boot, epoch, is_revoked, arrived,
             generation, is_ahead, is_double, offered FROM vehicles WHERE name IN ($1..)"; &names);
        Ok(rows.into_iter().map(|row| (row.name.clone(), row)).collect())
    }
}

/// Returns a vehicle if its connection `epoch` still counts.
pub(super) fn counting<'v>(
    vehicles: &'v mut GroupVehicles,
    name: &str,
    epoch: i64,
) -> CloudResult<&'v mut GroupVehicle> {
    let vehicle = vehicles.get_mut(name).filter(|it| it.epoch == epoch && !it.is_revoked);
    vehicle.ok_or_else(super::vehicles::ended)
}

pub(super) fn stopped() -> CloudError {
    CloudError::busy("the cloud stops", "connect again")
}
