//! Files that offered deployments wait for: any replica may receive them.

use gleaner_protocol::vehicle_api::MissingObject;

use super::{CloudStore, now};
use crate::error::{CloudError, CloudResult};

const OFFERS_MAX: i64 = 64;
/// Time for which a deployment waits for its files, in s.
const OFFER_S: i64 = 86_400;

impl CloudStore {
    /// Accepts these files from now on, for the deployment `id`; without any, none for it.
    pub(crate) async fn await_files(&self, id: &str, files: &[MissingObject]) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change;
            "DELETE FROM awaited_files WHERE deployment = $1 OR time <= $2"; id, now() - OFFER_S);
        let count: i64 = one!(change; "SELECT COUNT(DISTINCT deployment) FROM awaited_files");
        if !files.is_empty() && count >= OFFERS_MAX {
            let help = "send the files of those that were offered, or wait a day";
            return Err(CloudError::busy("too many deployments wait for files", help));
        }
        for file in files {
            run!(change; "INSERT INTO awaited_files (deployment, sha256, bytes, time)
                 VALUES ($1, $2, $3, $4)"; id, &file.sha256, file.bytes, now());
        }
        change.commit().await
    }

    pub(crate) async fn awaited_length(&self, sha256: &str) -> CloudResult<u64> {
        let bytes: Option<u64> =
            row!(self; "SELECT bytes FROM awaited_files WHERE sha256 = $1"; sha256);
        bytes.ok_or_else(|| {
            let help = "send the deployment first, and then the files that are missing";
            CloudError::usage(format!("no deployment needs the file {sha256}"), help)
        })
    }
}
