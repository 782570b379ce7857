//! Which files can be opened: Landlock, for this thread and what it starts. TCP, signals and abstract sockets go with it.

use std::path::{Path, PathBuf};

use gleaner_protocol::Layer;
use landlock::{
    ABI, Access, AccessFs, AccessNet, CompatLevel, Compatible, LandlockStatus, Ruleset, RulesetAttr,
    RulesetCreatedAttr, RulesetStatus, Scope, path_beneath_rules,
};

use crate::JailError;

/// The name of this layer.
pub const NAME: &str = "files";

/// The newest rules that are used. Older kernels leave some out, and the layer says so.
const RULES: ABI = ABI::V6;

/// Programs and libraries, and what they read to begin: nothing in them is somebody's secret. Not `/etc`, but for what the
/// loader and the calendar need.
const SYSTEM: [&str; 14] = [
    "/usr",
    "/lib",
    "/lib64",
    "/bin",
    "/sbin",
    "/etc/ld.so.cache",
    "/etc/ld.so.conf",
    "/etc/ld.so.conf.d",
    "/etc/alternatives",
    "/etc/localtime",
    "/proc",
    "/sys/devices/system",
    "/sys/class/net",
    "/sys/devices/virtual/net",
];
/// Devices that everybody may use.
const DEVICES: [&str; 5] = ["/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom"];

/// What may be opened, beside the system's programs and libraries. What does not exist is left out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Paths {
    /// Files, and folders with all below them, that may be read and run.
    pub read: Vec<PathBuf>,
    /// Files and folders that may be read and written.
    pub write: Vec<PathBuf>,
}

impl Paths {
    /// Adds what the interpreter `program` needs: of its own folder, and of the one that it was made from, programs and libraries.
    pub fn interpreter(&mut self, program: &Path) {
        let real = program.canonicalize().ok();
        for bin in [Some(program), real.as_deref()].into_iter().flatten().filter_map(Path::parent) {
            let Some(prefix) = bin.parent() else { continue };
            self.read.push(bin.to_owned());
            self.read.extend(["lib", "lib64", "pyvenv.cfg"].map(|name| prefix.join(name)));
        }
    }
}

/// From now on this thread, and what it starts, can open only `paths` and the system's programs and libraries.
pub fn confine(paths: &Paths) -> Layer {
    match restrict(paths) {
        Ok(layer) => layer,
        Err(error) => Layer::no(NAME, error.told()),
    }
}

/// From now on this thread, and what it starts, can change only `paths`; what it can read stays as it is. None if that
/// changes nothing that is to be told.
pub fn confine_writes(paths: &[PathBuf]) -> Option<Layer> {
    let restricted = restrict_writes(paths);
    restricted.err().map(|error| Layer::partly(NAME, format!("the results can still be changed: {}", error.told())))
}

fn restrict_writes(paths: &[PathBuf]) -> Result<(), JailError> {
    let write = AccessFs::from_write(RULES);
    Ruleset::default()
        .set_compatibility(CompatLevel::BestEffort)
        .handle_access(write)?
        .create()?
        .add_rules(path_beneath_rules(DEVICES, write))?
        .add_rules(path_beneath_rules(paths, write))?
        .restrict_self()?;
    Ok(())
}

fn restrict(paths: &Paths) -> Result<Layer, JailError> {
    let (read, all) = (AccessFs::from_read(RULES), AccessFs::from_all(RULES));
    let status = Ruleset::default()
        .set_compatibility(CompatLevel::BestEffort)
        .handle_access(all)?
        // Without a rule that allows a port, none is.
        .handle_access(AccessNet::from_all(RULES))?
        .scope(Scope::from_all(RULES))?
        .create()?
        .add_rules(path_beneath_rules(SYSTEM, read))?
        .add_rules(path_beneath_rules(DEVICES, all))?
        .add_rules(path_beneath_rules(&paths.read, read))?
        .add_rules(path_beneath_rules(&paths.write, all))?
        .restrict_self()?;
    Ok(match (status.ruleset, status.landlock) {
        (RulesetStatus::NotEnforced, LandlockStatus::NotImplemented) => {
            Layer::no(NAME, "this kernel has no Landlock; it came with Linux 5.13")
        }
        (RulesetStatus::NotEnforced, _) => {
            Layer::no(NAME, "Landlock is not switched on; add it to the kernel's parameter lsm=")
        }
        (RulesetStatus::FullyEnforced, _) => {
            Layer::yes(NAME, "Landlock: only what belongs to the lambda; no TCP, no signals to others")
        }
        (RulesetStatus::PartiallyEnforced, LandlockStatus::Available { effective_abi, .. }) => {
            let abi = effective_abi as i32;
            let lacks =
                [(2, "renaming across folders"), (3, "cutting files"), (4, "TCP"), (5, "devices"), (6, "signals")];
            let lacks: Vec<_> = lacks.iter().filter(|(since, _)| *since > abi).map(|(_, what)| *what).collect();
            Layer::partly(
                NAME,
                format!("Landlock {abi}: only what belongs to the lambda; not watched: {}", lacks.join(", ")),
            )
        }
        (RulesetStatus::PartiallyEnforced, _) => {
            Layer::partly(NAME, "Landlock: some rules are not known to this kernel")
        }
    })
}
