//! Releases of the one lambda that simulated vehicles are to run.

use gleaner_fleet::people::FleetDeployRequest;
use gleaner_fleet::waves::WavePlan;
use gleaner_trust::{Deployment, Grants, Revision, RevisionFile, SecretKey, seal, sha256};
use hyper::Method;
use serde_json::{Value, json};

use crate::administrator::Administrator;

/// Id of the deployment.
pub const DEPLOYMENT: &str = "brake-dark";
/// The file of its lambda.
const FILE: &[u8] = b"content of a lambda";

/// A signed release for the whole fleet.
pub struct SignedRelease {
    pub number: u64,
    /// SHA-256 of its envelope, by which a cloud names it to vehicles.
    pub envelope: String,
    request: FleetDeployRequest,
}

impl SignedRelease {
    /// Signs a release; without waves, it reaches all vehicles at once.
    pub fn new(number: u64, waves: Option<WavePlan>) -> Result<Self, String> {
        let failed = |error: &dyn std::fmt::Display| error.to_string();
        let key = SecretKey::generate().map_err(|error| failed(&error))?;
        let revision = Revision {
            name: DEPLOYMENT.parse().map_err(|error| failed(&error))?,
            version: "1.0.0".parse().map_err(|error| failed(&error))?,
            kind: serde_json::from_value(json!("wasm")).map_err(|error| failed(&error))?,
            release: number,
            created: 1,
            files: vec![RevisionFile {
                path: "lambda.toml".parse().map_err(|error| failed(&error))?,
                bytes: FILE.len() as u64,
                sha256: sha256(FILE),
            }],
        };
        let digest = serde_json::to_vec(&revision).map_err(|error| failed(&error))?;
        let selector = "fleet".parse().map_err(|error| failed(&error))?;
        let deployment = Deployment {
            id: DEPLOYMENT.parse().map_err(|error| failed(&error))?,
            release: number,
            selector: [(selector, "simulated".to_owned())].into(),
            revision: sha256(&digest),
            fallback: None,
            config: [].into(),
            grants: Grants::default(),
            created: 1,
            expires: 2,
        };
        let sealed = seal(&deployment, &[&key]).map_err(|error| failed(&error))?;
        let revision = seal(&revision, &[&key]).map_err(|error| failed(&error))?;
        let text = |envelope: &[u8]| String::from_utf8_lossy(envelope).into_owned();
        let request = FleetDeployRequest {
            deployment: text(&sealed),
            revisions: vec![text(&revision)],
            waves,
        };
        Ok(Self { number, envelope: sha256(&sealed).to_string(), request })
    }

    /// Deploys it, once however often this is repeated.
    pub async fn deploy(&self, administrator: &mut Administrator) -> Result<(), String> {
        let body = serde_json::to_vec(&self.request).map_err(|error| error.to_string())?;
        let path = "/v1/deployments";
        loop {
            let key = Some(("idempotency-key", format!("release-{}", self.number)));
            let reply = administrator.bytes(Method::POST, path, key, body.clone()).await?;
            let reply: Value =
                serde_json::from_slice(&reply).map_err(|error| format!("{path}: {error}"))?;
            if reply["result"] != "missing" {
                return Ok(());
            }
            let path = format!("/v1/objects/{}", sha256(FILE));
            administrator.bytes(Method::PUT, &path, None, FILE.to_vec()).await?;
        }
    }
}
