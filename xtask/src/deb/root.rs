//! Tests a package in roots of their own: installs, runs, upgrades, removes and purges it there,
//! without a network. `test/in-root` runs without systemd, and `test/booted` in a container of
//! `systemd-nspawn`. Nothing of this machine is changed.

use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};

use super::source::PackageSource;
use super::{answer, tree};
use crate::checkout::Checkout;
use crate::steps::{self, cannot};

/// Packages of the root, beyond those that are required: for Python lambdas, and the units.
const PACKAGES: &str = "dbus,init-system-helpers,python3,python3-numpy,python3-venv,systemd";
/// Release of Debian, unless `GLEANER_SUITE` names another one.
const SUITE: &str = "bookworm";
/// Lambdas of both kinds, with different names, that are deployed there if they are built.
const LAMBDAS: [&str; 2] = ["examples/hello/rust", "examples/brake-dark/python"];
/// A lambda with a model, which is only checked there, as the folder `model`.
const WITH_MODEL: &str = "examples/yolo-detector/rust";
/// System calls that a container needs beyond those of systemd-nspawn.
const CALLS: &str = "landlock_add_rule landlock_create_ruleset landlock_restrict_self pidfd_getfd";
/// The unit that runs the test in a container, and ends it.
const TEST_UNIT: &str = "\
[Unit]
After=multi-user.target
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
ExecStart=/bin/sh -c 'exec /test/booted @ARGUMENTS@ >/test/log 2>&1'
TimeoutStartSec=10min
";

pub(super) fn test(
    checkout: &Checkout,
    package: &Path,
    work: &Path,
    source: &PackageSource,
) -> Result<(), Failure> {
    if answer(checkout.command("id").arg("-u")).as_deref() != Some("0") {
        return Err(Failure::new(Exit::Usage, "only root can install a package into a root")
            .with_help("run `cargo xtask deb`, then `sudo cargo xtask deb --test`"));
    }
    steps::require(checkout, &[("debootstrap", "debootstrap"), ("unshare", "util-linux")])?;
    let base = base(checkout, work)?;
    let (root, arguments) = prepare(checkout, &base, work, package, source)?;
    println!("{}, without systemd", root.display());
    // `ip` of this machine, as the root need not have it.
    let script = "if command -v ip >/dev/null; then ip link set lo up multicast on; \
                  ip route add 224.0.0.0/4 dev lo; fi; mount -t proc proc \"$1/proc\" && \
                  root=$1 && shift && exec chroot \"$root\" \"$@\"";
    let mut run = checkout.command("unshare");
    run.args(["--mount", "--pid", "--net", "--ipc", "--uts", "--fork", "--kill-child"]);
    run.args(["sh", "-c", script, "sh"]).arg(&root);
    run.args(["/usr/bin/env", "-i", "/test/in-root"]).args(&arguments);
    steps::run(&mut run, "its output is above; the log of the service is test/log in that root")?;
    if !checkout.path(source.folder).join("test/booted").exists() {
        return Ok(());
    }
    if !steps::succeeds(checkout.command("systemd-nspawn").arg("--version")) {
        println!("skipped: no test with systemd, as systemd-nspawn (systemd-container) is missing");
        return Ok(());
    }
    let (root, arguments) = prepare(checkout, &base, work, package, source)?;
    println!("{}, with systemd", root.display());
    boot(checkout, &root, &arguments)
}

/// Makes the root that the tests copy, once.
fn base(checkout: &Checkout, work: &Path) -> Result<PathBuf, Failure> {
    let suite = std::env::var("GLEANER_SUITE").unwrap_or_else(|_| SUITE.to_owned());
    let base = work.join(&suite);
    if !base.join("etc/debian_version").exists() {
        println!("debootstrap {suite} (minutes)");
        let unfinished = work.join(format!("{suite}.new"));
        let _ = fs::remove_dir_all(&unfinished);
        let mut make = checkout.command("debootstrap");
        make.args(["--variant=minbase", &format!("--include={PACKAGES}"), &suite]).arg(&unfinished);
        steps::download(&mut make, "check the network")?;
        fs::rename(&unfinished, &base).map_err(|error| cannot("move", &base, &error))?;
    }
    Ok(base)
}

/// Copies the root, and puts package, lambdas and scripts into it. Returns its path and the
/// arguments of the scripts.
fn prepare(
    checkout: &Checkout,
    base: &Path,
    work: &Path,
    package: &Path,
    source: &PackageSource,
) -> Result<(PathBuf, Vec<String>), Failure> {
    let root = work.join("root");
    let _ = fs::remove_dir_all(&root);
    copy(checkout, base, &root)?;
    let test = root.join("test");
    fs::create_dir(&test).map_err(|error| cannot("create", &test, &error))?;
    copy(checkout, package, &test.join("gleaner.deb"))?;
    for script in ["in-root", "booted"] {
        let script = checkout.path(source.folder).join("test").join(script);
        if script.exists() {
            copy(checkout, &script, &test)?;
        }
    }
    if source.has_command && checkout.path(WITH_MODEL).join("build").exists() {
        copy(checkout, &checkout.path(WITH_MODEL), &test.join("model"))?;
    }
    let mut arguments = vec!["/test/gleaner.deb".to_owned()];
    for lambda in LAMBDAS.iter().filter(|_| source.has_command) {
        if checkout.path(lambda).join("build").exists() {
            let name = lambda.replace('/', "-");
            copy(checkout, &checkout.path(lambda), &test.join(&name))?;
            arguments.push(name);
        } else {
            println!("skipped: {lambda} is not built; `cargo xtask build` builds it");
        }
    }
    Ok((root, arguments))
}

/// Boots the root in a container, and shows the output of the test.
fn boot(checkout: &Checkout, root: &Path, arguments: &[String]) -> Result<(), Failure> {
    let units = root.join("etc/systemd/system");
    let wants = units.join("default.target.wants");
    let unit = TEST_UNIT.replace("@ARGUMENTS@", &arguments.join(" "));
    fs::create_dir_all(&wants)
        .and_then(|()| fs::write(units.join("test.service"), unit))
        .and_then(|()| std::os::unix::fs::symlink("../test.service", wants.join("test.service")))
        .map_err(|error| cannot("write", &units, &error))?;
    let mut boot = checkout.command("systemd-nspawn");
    boot.args(["--quiet", "--boot", "--private-network", "--register=no", "--keep-unit"]);
    boot.arg(format!("--system-call-filter={CALLS}"));
    boot.args(["--console=pipe", "--directory"]).arg(root);
    // Its exit code is that of the container, not that of the test.
    let _ = boot.stdin(std::process::Stdio::null()).output();
    let log = tree::read(&root.join("test/log")).unwrap_or_default();
    print!("{log}");
    if log.ends_with("-- passed\n") {
        return Ok(());
    }
    Err(Failure::new(Exit::Differs, "the test of the service failed; its output is above"))
}

fn copy(checkout: &Checkout, from: &Path, to: &Path) -> Result<(), Failure> {
    let mut copy = checkout.command("cp");
    steps::run(copy.args(["-a", "--"]).arg(from).arg(to), "see the error above")
}
