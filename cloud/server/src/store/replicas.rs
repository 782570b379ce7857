//! Processes that serve one database: their leases, their connections of vehicles, and what others
//! of them have changed.
//!
//! A process whose lease has ended is not online, and neither are its vehicles. The clocks of the
//! replicas' machines have to agree within seconds.

use super::writer::{GroupVehicles, VehicleWrite, Waiting, WaitingWrite, counting};
use super::{CloudStore, StoreChange, in_list, int, now, parts, unsigned};
use crate::error::{CloudError, CloudResult};
use crate::sqlx::{self, AssertSqlSafe};

/// Lifetime of a lease, in s: several times the interval at which it is renewed.
const LEASE_S: i64 = 15;

/// The newest connection of a vehicle, which this process has.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct OwnLink {
    pub(crate) vehicle: String,
    pub(crate) epoch: u64,
    /// Number of the wanted state.
    pub(crate) generation: u64,
}

pub(super) struct DisconnectWrite {
    vehicle: String,
    epoch: u64,
}

impl VehicleWrite for DisconnectWrite {
    type Done = ();

    const WAITING: fn(Waiting<Self>) -> WaitingWrite = WaitingWrite::Disconnect;

    fn vehicle(&self) -> &str {
        &self.vehicle
    }
}

impl CloudStore {
    /// Returns the name of this process among the replicas.
    pub(crate) fn replica(&self) -> &str {
        &self.replica
    }

    /// Returns whether other processes can serve the database, too.
    pub(crate) fn is_shared(&self) -> bool {
        !self.is_file
    }

    /// Begins the lease of this process. `former` is the process before it with the same folder,
    /// which has ended; a database in a folder has no others. `is_alone` refuses to serve beside
    /// another one.
    ///
    /// # Errors
    ///
    /// An error if another process serves the database, and this one has to be alone.
    pub(crate) async fn begin_lease(&self, former: &str, is_alone: bool) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(&mut *change.tx;
            "DELETE FROM replicas WHERE $1 = 1 OR id = $2 OR until <= $3";
            i64::from(self.is_file), former, now());
        let (others,): (i64,) = one!(&mut *change.tx; "SELECT COUNT(*) FROM replicas");
        if is_alone && others > 0 {
            let message = "another gleaner-cloud serves the database, and files are in a folder";
            let help = "stop that one, and wait 15 s if its machine was lost; or serve a new \
                        database with --objects s3://BUCKET, which several processes can use";
            return Err(CloudError::usage(message, help));
        }
        change.extend_lease(&self.replica, self.is_file).await?;
        change.commit().await
    }

    /// Renews the lease of this process, and removes those that have ended. Returns false if the
    /// process has to be alone, and another one has begun meanwhile.
    pub(crate) async fn renew_lease(&self, is_alone: bool) -> CloudResult<bool> {
        let mut change = self.change().await?;
        run!(&mut *change.tx; "DELETE FROM replicas WHERE until <= $1"; now());
        let (others,): (i64,) =
            one!(&mut *change.tx; "SELECT COUNT(*) FROM replicas WHERE id <> $1"; &self.replica);
        if is_alone && others > 0 {
            return Ok(false);
        }
        change.extend_lease(&self.replica, self.is_file).await?;
        change.commit().await.map(|()| true)
    }

    /// Ends the lease of this process: its vehicles are offline from now on.
    pub(crate) async fn end_lease(&self) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(&mut *change.tx; "DELETE FROM replicas WHERE id = $1"; &self.replica);
        change.commit().await
    }

    /// Notes the end of a connection, unless there is a newer one.
    pub(crate) async fn disconnect(&self, vehicle: &str, epoch: u64) -> CloudResult<()> {
        self.write(DisconnectWrite { vehicle: vehicle.to_owned(), epoch }).await
    }

    /// Returns the vehicles whose newest connections this process has: all, or those in `only`.
    pub(crate) async fn own_links(&self, only: Option<&[String]>) -> CloudResult<Vec<OwnLink>> {
        let sql = "SELECT name, epoch, generation FROM vehicles
                   WHERE replica = $1 AND is_revoked = 0";
        let mut rows: Vec<(String, i64, i64)> = Vec::new();
        match only {
            None => rows = rows!(&self.pool; sql; &self.replica),
            Some(names) => {
                for part in parts(names) {
                    let (list, last) = (in_list(part.len()), part.len() + 1);
                    let sql = sql.replace("$1", &format!("${last}"));
                    let sql = AssertSqlSafe(format!("{sql} AND name IN ({list})"));
                    let query = sqlx::query_as(sql);
                    let query = part.iter().fold(query, |query, name| query.bind(name));
                    let query = query.bind(&self.replica);
                    rows.extend(query.fetch_all(&self.pool).await?);
                }
            }
        }
        let link = |(vehicle, epoch, generation)| {
            let (epoch, generation) = (unsigned(epoch), unsigned(generation));
            OwnLink { vehicle, epoch, generation }
        };
        Ok(rows.into_iter().map(link).collect())
    }
}

impl StoreChange<'_> {
    /// Notes the ends of connections, of which those that still count were the newest ones.
    pub(super) async fn disconnect_all(
        &mut self,
        vehicles: &mut GroupVehicles,
        ends: &mut [&mut Waiting<DisconnectWrite>],
    ) -> CloudResult<()> {
        let mut names = Vec::new();
        for waiting in ends.iter_mut() {
            let DisconnectWrite { vehicle, epoch } = &waiting.write;
            waiting.result = Some(Ok(()));
            if counting(vehicles, vehicle, int(*epoch)).is_ok() {
                names.push(vehicle.clone());
            }
        }
        self.run_in("UPDATE vehicles SET replica = '' WHERE name IN", &names).await
    }

    async fn extend_lease(&mut self, replica: &str, is_endless: bool) -> CloudResult<()> {
        let until = if is_endless { i64::MAX } else { now() + LEASE_S };
        run!(&mut *self.tx;
            "INSERT INTO replicas (id, until) VALUES ($1, $2)
             ON CONFLICT (id) DO UPDATE SET until = excluded.until";
            replica, until);
        Ok(())
    }
}
