//! Tests the package in a root of its own: installs, runs, upgrades, removes and purges it there, in
//! namespaces without a network. Nothing of this machine is changed.

use std::fs;
use std::path::Path;

use gleaner_base::{Exit, Failure};

use super::{SOURCE, answer, tree};
use crate::checkout::Checkout;
use crate::steps;

/// Packages of the root, beyond those that are required: for Python lambdas, and the units.
const PACKAGES: &str = "init-system-helpers,python3,python3-numpy,python3-venv,systemd";
/// Release of Debian, unless `GLEANER_SUITE` names another one.
const SUITE: &str = "bookworm";
/// Lambdas of both kinds, of different names, that are deployed there if they are built.
const LAMBDAS: [&str; 2] = ["examples/hello/rust", "examples/brake-dark/python"];

/// Runs the test.
pub(super) fn test(checkout: &Checkout, package: &Path, work: &Path) -> Result<(), Failure> {
    if answer(checkout.command("id").arg("-u")).as_deref() != Some("0") {
        return Err(Failure::new(Exit::Usage, "only root can install a package into a root")
            .with_help("run `cargo xtask deb`, then `sudo cargo xtask deb --test`"));
    }
    for (tool, package) in [("debootstrap", "debootstrap"), ("unshare", "util-linux")] {
        if !steps::succeeds(checkout.command(tool).arg("--version")) {
            return Err(Failure::new(Exit::Unreachable, format!("`{tool}` is missing"))
                .with_help(format!("on Debian and Ubuntu, as root: apt-get install {package}")));
        }
    }
    let suite = std::env::var("GLEANER_SUITE").unwrap_or_else(|_| SUITE.to_owned());
    let (base, root) = (work.join(&suite), work.join("root"));
    if !base.join("etc/debian_version").exists() {
        println!("debootstrap {suite} (minutes)");
        let unfinished = work.join(format!("{suite}.new"));
        let _ = fs::remove_dir_all(&unfinished);
        let mut make = checkout.command("debootstrap");
        make.args(["--variant=minbase", &format!("--include={PACKAGES}"), &suite]).arg(&unfinished);
        steps::run(&mut make, "check the network")
            .map_err(|failure| Failure { exit: Exit::Unreachable, ..failure })?;
        fs::rename(&unfinished, &base).map_err(|error| tree::cannot("move", &base, &error))?;
    }
    let _ = fs::remove_dir_all(&root);
    copy(checkout, &base, &root)?;
    let test = root.join("test");
    fs::create_dir(&test).map_err(|error| tree::cannot("create", &test, &error))?;
    copy(checkout, package, &test)?;
    copy(checkout, &checkout.path(SOURCE).join("test/in-root"), &test)?;
    let mut lambdas = Vec::new();
    for lambda in LAMBDAS {
        if checkout.path(lambda).join("build").exists() {
            let name = lambda.replace('/', "-");
            copy(checkout, &checkout.path(lambda), &test.join(&name))?;
            lambdas.push(name);
        } else {
            println!("skipped: {lambda} is not built; `cargo xtask build` builds it");
        }
    }
    let name = package.file_name().unwrap_or_default();
    // `ip` of this machine, as the root need not have it.
    let script = "if command -v ip >/dev/null; then ip link set lo up multicast on; \
                  ip route add 224.0.0.0/4 dev lo; fi; mount -t proc proc \"$1/proc\" && \
                  root=$1 && shift && exec chroot \"$root\" \"$@\"";
    let mut run = checkout.command("unshare");
    run.args(["--mount", "--pid", "--net", "--ipc", "--uts", "--fork", "--kill-child"]);
    run.args(["sh", "-c", script, "sh"]).arg(&root);
    run.args(["/usr/bin/env", "-i", "/test/in-root"]).arg(Path::new("/test").join(name));
    run.args(lambdas);
    steps::run(&mut run, "its output is above; the log is test/log in that root")
}

fn copy(checkout: &Checkout, from: &Path, to: &Path) -> Result<(), Failure> {
    let mut copy = checkout.command("cp");
    steps::run(copy.args(["-a", "--"]).arg(from).arg(to), "see the error above")
}
