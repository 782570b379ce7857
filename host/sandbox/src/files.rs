//! Restricts the files that a process can open, and TCP, signals and abstract sockets, by Landlock,
//! for this thread and its descendants.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use gleaner_protocol::Layer;
use landlock::{
    ABI, Access, AccessFs, AccessNet, BitFlags, CompatLevel, Compatible, LandlockStatus,
    RestrictionStatus, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetStatus, Scope,
    path_beneath_rules,
};

use crate::{JailError, needed};

pub const NAME: &str = "files";
/// The name of the layer that restricts changes only.
pub const WRITTEN: &str = "changes of files";

/// The newest version of the rules in use. Older kernels lack some, and the layer names these.
const RULES: ABI = ABI::V6;

/// Programs, libraries and their start-up files: none of them holds secrets. Without `/etc`, but
/// for the files of the loader and of the calendar, and without `/usr/local/etc`, where installed
/// programs keep tokens.
const SYSTEM: [&str; 24] = [
    "/usr/bin",
    "/usr/lib",
    "/usr/lib32",
    "/usr/lib64",
    "/usr/libexec",
    "/usr/share",
    "/usr/local/bin",
    "/usr/local/cuda",
    "/usr/local/lib",
    "/usr/local/lib64",
    "/usr/local/share",
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
/// Devices for every user. Only for reading: a process that can write to `/dev/zero` could share it
/// as memory, which no limit counts.
const DEVICES: [&str; 4] = ["/dev/zero", "/dev/full", "/dev/random", "/dev/urandom"];
const NOTHING: [&str; 1] = ["/dev/null"];

/// Paths that may be opened, beside the system's programs and libraries. Those that do not exist
/// are skipped.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Paths {
    /// Files, and folders with everything below them, that may be read and run.
    pub read: Vec<PathBuf>,
    /// Files and folders that may be read and written.
    pub write: Vec<PathBuf>,
}

impl Paths {
    /// Adds the programs and libraries of the interpreter `program`: of its own folder, and of the
    /// one that it was created from. Of a virtual environment only real paths inside it are added:
    /// its author may have put links there that lead to anything.
    pub fn interpreter(&mut self, program: &Path) {
        self.read.extend(
            parts_of(program)
                .into_iter()
                .filter(|(prefix, part)| part.starts_with(prefix))
                .map(|it| it.1),
        );
        // The links of the system's own interpreters are trusted.
        let real = program.canonicalize().ok();
        self.read
            .extend(real.as_deref().map(parts_of).unwrap_or_default().into_iter().map(|it| it.1));
    }
}

/// Returns the real folder of the environment around the interpreter `program`, with each real path
/// that is needed of it.
fn parts_of(program: &Path) -> Vec<(PathBuf, PathBuf)> {
    let Some(prefix) =
        program.parent().and_then(Path::parent).and_then(|prefix| prefix.canonicalize().ok())
    else {
        return Vec::new();
    };
    let bin = program.parent().map(Path::to_owned);
    let others = ["lib", "lib64", "pyvenv.cfg"].map(|name| prefix.join(name));
    let real = bin.into_iter().chain(others).filter_map(|part| part.canonicalize().ok());
    real.map(|part| (prefix.clone(), part)).collect()
}

/// Restricts this thread and its descendants: they can open only `paths` and the system's programs
/// and libraries.
pub fn confine(paths: &Paths) -> Layer {
    let restricted = restrict(paths, AccessNet::from_all(RULES));
    layer(NAME, "only the lambda's files; no TCP, no signals to others", restricted)
}

/// Restricts a program of Gleaner as [`confine`] does.
pub(crate) fn confine_program(paths: &Paths) -> Layer {
    let restricted = restrict(paths, AccessNet::from_all(RULES));
    layer(NAME, "only the files that it needs; no TCP, no signals to others", restricted)
}

/// Restricts a program as [`confine`] does, but it can connect by TCP.
pub(crate) fn confine_client(paths: &Paths) -> Layer {
    let restricted = restrict(paths, AccessNet::BindTcp.into());
    layer(NAME, "only the files that it needs; no signals to others", restricted)
}

/// Restricts this thread and its descendants: they can change only `paths`. Reading is not
/// restricted.
pub fn confine_writes(paths: &[PathBuf]) -> Layer {
    layer(WRITTEN, "files are changed only in the folder of results", restrict_writes(paths))
}

fn restrict_writes(paths: &[PathBuf]) -> Result<RestrictionStatus, JailError> {
    let write = AccessFs::from_write(RULES);
    Ok(Ruleset::default()
        .set_compatibility(CompatLevel::BestEffort)
        .handle_access(write)?
        .create()?
        .add_rules(path_beneath_rules(NOTHING, write))?
        .add_rules(path_beneath_rules(paths, write))?
        .restrict_self()?)
}

fn restrict(paths: &Paths, denied: BitFlags<AccessNet>) -> Result<RestrictionStatus, JailError> {
    let (read, all) = (AccessFs::from_read(RULES), AccessFs::from_all(RULES));
    Ok(Ruleset::default()
        .set_compatibility(CompatLevel::BestEffort)
        .handle_access(all)?
        // Without a rule that allows a port, none is.
        .handle_access(denied)?
        .scope(Scope::from_all(RULES))?
        .create()?
        .add_rules(path_beneath_rules(SYSTEM, read))?
        .add_rules(path_beneath_rules(DEVICES, read))?
        .add_rules(path_beneath_rules(NOTHING, all))?
        .add_rules(path_beneath_rules(&paths.read, read))?
        .add_rules(path_beneath_rules(&paths.write, all))?
        .restrict_self()?)
}

/// Describes the layer `name` that allows `what`.
fn layer(name: &str, what: &str, restricted: Result<RestrictionStatus, JailError>) -> Layer {
    let status = match restricted {
        Ok(status) => status,
        Err(error) => return Layer::no(name, error.chain()),
    };
    match (status.ruleset, status.landlock) {
        (RulesetStatus::NotEnforced, LandlockStatus::NotImplemented) => {
            match needed::refusal(libc::SYS_landlock_create_ruleset) {
                Some(error) if error.kind() != ErrorKind::Unsupported => {
                    Layer::no(name, format!("a filter refuses Landlock: {error}"))
                }
                _ => Layer::no(name, "this kernel has no Landlock; it came with Linux 5.13"),
            }
        }
        (RulesetStatus::NotEnforced, _) => {
            Layer::no(name, "Landlock is not switched on; add it to the kernel's parameter lsm=")
        }
        (RulesetStatus::FullyEnforced, _) => Layer::yes(name, format!("Landlock: {what}")),
        (RulesetStatus::PartiallyEnforced, LandlockStatus::Available { effective_abi, .. }) => {
            let abi = effective_abi as i32;
            let lacks = [
                (2, "renaming across folders"),
                (3, "truncating files"),
                (4, "TCP"),
                (5, "devices"),
                (6, "signals"),
            ];
            let lacks: Vec<_> =
                lacks.iter().filter(|(since, _)| *since > abi).map(|(_, what)| *what).collect();
            let lacks = lacks.join(", ");
            Layer::partly(name, format!("Landlock {abi}: {what}; not restricted: {lacks}"))
        }
        (RulesetStatus::PartiallyEnforced, _) => {
            Layer::partly(name, "Landlock: this kernel lacks some rules")
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn links_that_lead_out_of_an_environment_open_nothing() {
        let folder =
            std::env::temp_dir().join(format!("gleaner-jail-files-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let folder = folder.canonicalize().unwrap();
        let (venv, real) = (folder.join("lambda/.venv"), folder.join("python"));
        for created in [
            venv.join("bin"),
            venv.join("lib"),
            real.join("bin"),
            real.join("lib"),
            folder.join("secret"),
        ] {
            fs::create_dir_all(created).unwrap();
        }
        fs::write(folder.join("secret/key"), "").unwrap();
        fs::write(real.join("bin/python3"), "").unwrap();
        symlink(real.join("bin/python3"), venv.join("bin/python3")).unwrap();
        let paths = || {
            let mut paths = Paths::default();
            paths.interpreter(&venv.join("bin/python3"));
            assert!(paths.write.is_empty());
            paths.read
        };
        let in_venv = [venv.join("bin"), venv.join("lib")];
        let in_base = [real.join("bin"), real.join("lib")];
        // As `python3 -m venv` makes it.
        symlink("lib", venv.join("lib64")).unwrap();
        assert_eq!(paths(), [&in_venv[..], &[venv.join("lib")], &in_base].concat());
        fs::remove_file(venv.join("lib64")).unwrap();
        // As made by an author who tries to read other files.
        symlink("/", venv.join("lib64")).unwrap();
        symlink(folder.join("secret/key"), venv.join("pyvenv.cfg")).unwrap();
        assert_eq!(paths(), [&in_venv[..], &in_base].concat());
        fs::remove_dir(venv.join("lib")).unwrap();
        symlink(folder.join("secret"), venv.join("lib")).unwrap();
        assert_eq!(paths(), [&in_venv[..1], &in_base].concat());
        fs::remove_dir_all(&folder).unwrap();
    }
}
