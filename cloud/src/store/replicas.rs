//! Processes that serve one database: their leases, their connections of vehicles, and what others
//! of them have changed.
//!
//! A process whose lease has ended is not online, and neither are its vehicles. The clocks of the
//! replicas' machines have to agree within seconds.

use super::counting::{GroupVehicles, counting};
use super::writer::{VehicleWrite, Waiting};
use super::{CloudStore, StoreChange, int, now};
use crate::error::{CloudError, CloudResult};

/// Lifetime of a lease, in s: several times the interval at which it is renewed.
const LEASE_S: i64 = 15;

typed! {
    /// The newest connection of a vehicle, which this process has.
    #[derive(Debug, PartialEq, Eq)]
    pub(crate) struct OwnLink {
        pub(crate) vehicle: String,
        pub(crate) epoch: u64,
        /// Number of the desired state.
        pub(crate) generation: u64,
    }
}

/// The end of the connection with this epoch.
pub(super) struct DisconnectWrite(u64);

impl VehicleWrite for DisconnectWrite {
    type Done = ();

    const TURN: u8 = 3;

    /// Notes the ends of connections, of which those that still count were the newest ones.
    async fn apply(
        change: &mut StoreChange<'_>,
        vehicles: &mut GroupVehicles,
        ends: &mut [&mut Waiting<Self>],
    ) -> CloudResult<()> {
        let mut names = Vec::new();
        for waiting in ends.iter_mut() {
            waiting.result = Some(Ok(()));
            if counting(vehicles, &waiting.vehicle, int(waiting.write.0)).is_ok() {
                names.push(&waiting.vehicle);
            }
        }
        change.run_in("UPDATE vehicles SET replica = '' WHERE name IN ($1..)", &names, &[]).await
    }
}

impl CloudStore {
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
    /// Fails if another process serves the database, and this one has to be alone.
    pub(crate) async fn begin_lease(&self, former: &str, is_alone: bool) -> CloudResult<()> {
        if self.lease(former, self.is_file, is_alone).await? {
            return Ok(());
        }
        let message = "another gleaner-cloud serves the database, and files are in a folder";
        let help = "stop that one, and wait 15 s if its machine was lost; or serve a new database \
                    with --objects s3://BUCKET, which several processes can use";
        Err(CloudError::usage(message, help))
    }

    /// Renews the lease of this process, and removes those that have ended. Returns false if the
    /// process has to be alone, and another one has begun meanwhile.
    pub(crate) async fn renew_lease(&self, is_alone: bool) -> CloudResult<bool> {
        self.lease("", false, is_alone).await
    }

    /// Extends the lease of this process, and removes those of `former`, or of all, or that have
    /// ended; returns false if it has to be alone, and is not.
    async fn lease(&self, former: &str, ends_all: bool, is_alone: bool) -> CloudResult<bool> {
        let mut change = self.change().await?;
        run!(change;
            "DELETE FROM replicas WHERE $1 = 1 OR id = $2 OR until <= $3"; ends_all, former, now());
        let others: i64 =
            one!(change; "SELECT COUNT(*) FROM replicas WHERE id <> $1"; &self.replica);
        if is_alone && others > 0 {
            return Ok(false);
        }
        let until = if self.is_file { i64::MAX } else { now() + LEASE_S };
        run!(change; "INSERT INTO replicas (id, until) VALUES ($1, $2)
             ON CONFLICT (id) DO UPDATE SET until = excluded.until"; &self.replica, until);
        change.commit().await.map(|()| true)
    }

    /// Ends the lease of this process: its vehicles are offline from now on.
    pub(crate) async fn end_lease(&self) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change; "DELETE FROM replicas WHERE id = $1"; &self.replica);
        change.commit().await
    }

    /// Notes the end of a connection, unless there is a newer one.
    pub(crate) async fn disconnect(&self, vehicle: &str, epoch: u64) -> CloudResult<()> {
        self.write(vehicle, DisconnectWrite(epoch)).await
    }

    /// Returns the vehicles whose newest connections this process has: all, or those in `only`.
    pub(crate) async fn own_links(&self, only: Option<&[String]>) -> CloudResult<Vec<OwnLink>> {
        const ALL: &str = "SELECT name AS vehicle, epoch, generation FROM vehicles
                           WHERE replica = $1 AND is_revoked = 0";
        Ok(match only {
            None => rows!(self; ALL; &self.replica),
            Some(names) => {
                rows_in!(self; &format!("{ALL} AND name IN ($2..)"); names; &self.replica)
            }
        })
    }
}
