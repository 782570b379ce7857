//! The connections of vehicles that count: of each vehicle the newest one, unless it was revoked.

use std::collections::HashMap;

use super::StoreChange;
use crate::error::{CloudError, CloudResult};

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
        /// The newest desired state that was sent to it.
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

impl StoreChange<'_> {
    pub(super) async fn group_vehicles(&mut self, names: &[&str]) -> CloudResult<GroupVehicles> {
        let rows: Vec<GroupVehicle> = rows_in!(self;
            "SELECT name, labels, digest, boot, former_boot, epoch, is_revoked, arrived,
             generation, is_ahead, is_double, offered FROM vehicles WHERE name IN ($1..)"; names);
        Ok(rows.into_iter().map(|row| (row.name.clone(), row)).collect())
    }

    /// Fails unless the vehicle counts: it may have been revoked since its request came.
    pub(super) async fn must_count(&mut self, vehicle: &str) -> CloudResult<()> {
        let counting: Option<String> = row!(self;
            "SELECT name FROM vehicles WHERE name = $1 AND is_revoked = 0"; vehicle);
        counting.map(drop).ok_or_else(ended)
    }
}

/// Returns a vehicle if its connection `epoch` still counts.
pub(super) fn counting<'v>(
    vehicles: &'v mut GroupVehicles,
    name: &str,
    epoch: i64,
) -> CloudResult<&'v mut GroupVehicle> {
    let vehicle = vehicles.get_mut(name).filter(|it| it.epoch == epoch && !it.is_revoked);
    vehicle.ok_or_else(ended)
}

/// Returns the error of a connection that does not count any more.
pub(super) fn ended() -> CloudError {
    let message = "this connection does not count: the vehicle has a newer one, or was revoked";
    CloudError::denied(message, "connect again")
}
