//! Packages, as `cargo metadata` lists them.

use gleaner_base::Failure;
use serde::Deserialize;

use crate::checkout::Checkout;
use crate::steps;

#[derive(Deserialize)]
pub(crate) struct Metadata {
    pub(crate) packages: Vec<Package>,
}

#[derive(Deserialize)]
pub(crate) struct Package {
    pub(crate) name: String,
    pub(crate) version: String,
    pub(crate) license: Option<String>,
    /// `None` for packages of the workspace.
    pub(crate) source: Option<String>,
    pub(crate) manifest_path: String,
    pub(crate) dependencies: Vec<Dependency>,
}

#[derive(Deserialize)]
pub(crate) struct Dependency {
    pub(crate) name: String,
    pub(crate) path: Option<String>,
}

impl Metadata {
    /// Reads those of the workspace, or with `--locked` in place of `--no-deps` all.
    pub(crate) fn read(checkout: &Checkout, which: &str) -> Result<Self, Failure> {
        let mut metadata = checkout.cargo();
        metadata.args(["metadata", "--format-version", "1", which]);
        steps::parsed(&steps::output(&mut metadata, "see the error above")?, "cargo metadata")
    }
}
