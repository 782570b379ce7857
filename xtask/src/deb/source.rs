//! The packages: what each consists of.

use crate::setup;

pub(crate) struct PackageSource {
    pub(crate) name: &'static str,
    /// Folder of its files that are not built.
    pub(crate) folder: &'static str,
    pub(crate) programs: &'static [&'static [(&'static str, &'static str)]],
    pub(crate) files: &'static [(&'static str, &'static str)],
    /// Packages of cargo whose crates the programs contain.
    pub(crate) cargo_packages: &'static [&'static [&'static str]],
    /// True if it has the command `gleaner` with its manual, what Python lambdas need, and ONNX
    /// Runtime.
    pub(crate) has_command: bool,
    /// The most exposure that `systemd-analyze security` may report of its service, in tenths. It
    /// counts what the service must do: the network, and for lambdas devices and memory with code.
    pub(crate) exposure_max: u32,
}

/// Folder of the parts, where the programs search for them.
pub(crate) const LIB: &str = "usr/lib/gleaner";

/// The program of `gleaner play`, and its package of cargo.
pub(crate) const PLAYER: &str = "gleaner-player";

/// Programs of a vehicle: the commands, the parts that those start, and the extension module of
/// Python.
pub(crate) const VEHICLE_PROGRAMS: [(&str, &str); 11] = [
    ("gleaner", "usr/bin"),
    ("gleaner-orchestrator", "usr/bin"),
    ("gleaner-compile", LIB),
    ("gleaner-inference", LIB),
    ("gleaner-ingress", LIB),
    ("gleaner-recorder", LIB),
    ("gleaner-runtime", LIB),
    ("gleaner-shim", LIB),
    ("gleaner-supervisor", LIB),
    ("lib_gleaner.so", LIB),
    (PLAYER, LIB),
];

const VEHICLE: PackageSource = PackageSource {
    name: "gleaner",
    folder: "orchestrator/package",
    programs: &[&VEHICLE_PROGRAMS],
    files: &[
        ("gleaner.service", "usr/lib/systemd/system/gleaner.service"),
        ("control-groups.conf", "usr/lib/gleaner/control-groups.conf"),
        ("gleaner-stop", "usr/lib/gleaner/gleaner-stop"),
        ("gleaner.sysusers", "usr/lib/sysusers.d/gleaner.conf"),
        ("gleaner.sysctl", "usr/lib/sysctl.d/00-00-gleaner.conf"),
        ("vehicle.toml", "etc/gleaner/vehicle.toml"),
        ("gleaner-orchestrator.8", "usr/share/man/man8/gleaner-orchestrator.8"),
        ("debian/copyright", "usr/share/doc/gleaner/copyright"),
        ("debian/README.Debian", "usr/share/doc/gleaner/README.Debian"),
        ("../../examples/data/highway_drive.mcap", "usr/share/gleaner/highway_drive.mcap"),
        ("../../examples/data/ATTRIBUTION.md", "usr/share/gleaner/ATTRIBUTION.md"),
    ],
    cargo_packages: &[&setup::PROGRAMS, &[PLAYER]],
    has_command: true,
    exposure_max: 20,
};

/// The cloud of a fleet, on another machine than a vehicle.
const CLOUD: PackageSource = PackageSource {
    name: "gleaner-cloud",
    folder: "cloud/package",
    programs: &[&[("gleaner-cloud", "usr/bin")]],
    files: &[
        ("gleaner-cloud.service", "usr/lib/systemd/system/gleaner-cloud.service"),
        ("gleaner-cloud.sysusers", "usr/lib/sysusers.d/gleaner-cloud.conf"),
        ("gleaner-cloud.default", "etc/default/gleaner-cloud"),
        ("debian/copyright", "usr/share/doc/gleaner-cloud/copyright"),
        ("debian/README.Debian", "usr/share/doc/gleaner-cloud/README.Debian"),
    ],
    cargo_packages: &[&["gleaner-cloud"]],
    has_command: false,
    exposure_max: 13,
};

pub(super) const PACKAGES: [PackageSource; 2] = [VEHICLE, CLOUD];

impl PackageSource {
    pub(super) fn doc(&self) -> String {
        format!("usr/share/doc/{}", self.name)
    }

    pub(super) fn unit(&self) -> String {
        format!("{}.service", self.name)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::Value;

    use super::*;
    use crate::checkout::Checkout;

    #[test]
    fn the_packages_have_every_program_that_is_built_and_files_that_exist() {
        let checkout = Checkout::find().unwrap();
        let mut metadata = checkout.cargo();
        metadata.args(["metadata", "--no-deps", "--format-version", "1"]);
        let metadata: Value = serde_json::from_slice(&metadata.output().unwrap().stdout).unwrap();
        let name = |it: &Value| it["name"].as_str().unwrap().to_owned();
        let built = metadata["packages"].as_array().unwrap().iter();
        let built = built.filter(|package| setup::PROGRAMS.contains(&name(package).as_str()));
        let built = built.flat_map(|package| package["targets"].as_array().unwrap());
        let mut built: BTreeSet<_> = built.filter(|it| it["kind"][0] == "bin").map(name).collect();
        // A library, and a program that is built separately.
        built.extend(["lib_gleaner.so", PLAYER].map(str::to_owned));
        let packed = PACKAGES.iter().flat_map(|source| source.programs.concat());
        assert_eq!(packed.map(|(name, _)| name.to_owned()).collect::<BTreeSet<_>>(), built);
        for source in &PACKAGES {
            let folder = checkout.path(source.folder);
            let missing = source.files.iter().find(|(file, _)| !folder.join(file).is_file());
            assert_eq!(missing, None);
        }
    }
}
