//! Packages of the workspace, as `cargo metadata` lists them.

use gleaner_base::{Exit, Failure};
use serde::Deserialize;

use crate::checkout::Checkout;
use crate::steps;

#[derive(Deserialize)]
pub(crate) struct Metadata {
    pub(crate) packages: Vec<Package>,
    workspace_default_members: Vec<String>,
}

#[derive(Deserialize)]
pub(crate) struct Package {
    id: String,
    pub(crate) name: String,
    pub(crate) manifest_path: String,
    pub(crate) dependencies: Vec<Dependency>,
    pub(crate) targets: Vec<Target>,
}

#[derive(Deserialize)]
pub(crate) struct Dependency {
    pub(crate) name: String,
    /// Folder of a package of the workspace.
    pub(crate) path: Option<String>,
}

#[derive(Deserialize)]
pub(crate) struct Target {
    pub(crate) name: String,
    /// Such as `lib`, `bin` or `test`.
    pub(crate) kind: Vec<String>,
    /// True if it is tested by default.
    pub(crate) test: bool,
}

impl Metadata {
    pub(crate) fn read(checkout: &Checkout) -> Result<Self, Failure> {
        let mut metadata = checkout.cargo();
        metadata.args(["metadata", "--no-deps", "--format-version", "1"]);
        let json = steps::output(&mut metadata, "see the error above")?;
        serde_json::from_str(&json).map_err(|error| {
            Failure::caused_by(Exit::Internal, "`cargo metadata` gave no description", &error)
        })
    }

    /// The packages that cargo builds and tests by default.
    pub(crate) fn default_members(&self) -> impl Iterator<Item = &Package> {
        self.packages.iter().filter(|package| self.workspace_default_members.contains(&package.id))
    }
}
