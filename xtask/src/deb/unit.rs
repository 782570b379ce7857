//! Checks of the service with `systemd-analyze`, which starts nothing.

use std::path::Path;

use gleaner_base::{Exit, Failure};

use super::answer;
use super::source::PackageSource;
use super::tree::{self, PackageTree};
use crate::checkout::Checkout;
use crate::steps::{self, cannot, write_file};

/// The first version that knows the keys of `control-groups.conf`.
const WITH_SUBGROUPS: u32 = 254;

/// Checks the unit in `tree`. Does nothing but print so if the tool is missing.
pub(super) fn check(
    checkout: &Checkout,
    tree: &PackageTree,
    work: &Path,
    source: &PackageSource,
) -> Result<(), Failure> {
    let Some(version) = answer(checkout.command("systemd-analyze").arg("--version")) else {
        println!("skipped: systemd-analyze is not installed (package systemd)");
        return Ok(());
    };
    let version = version.split_whitespace().nth(1).and_then(|word| word.parse::<u32>().ok());
    // The programs of the unit are in the tree, not in this machine's folders.
    let root = tree.root().display().to_string();
    let moved = |text: String| {
        ["/usr/bin/gleaner", "/usr/lib/gleaner/"]
            .iter()
            .fold(text, |text, path| text.replace(&format!("={path}"), &format!("={root}{path}")))
    };
    let folder = work.join("unit");
    let unit = folder.join(source.unit());
    let dropin = folder.join("gleaner.service.d/control-groups.conf");
    let _ = std::fs::remove_dir_all(&folder);
    write_file(
        &unit,
        &moved(tree::read(&tree.root().join("usr/lib/systemd/system").join(source.unit()))?),
    )?;
    let mut security = checkout.command("systemd-analyze");
    security.args(["security", "--offline=yes", "--no-pager"]).arg(&unit);
    security.arg(format!("--threshold={}", source.exposure_max));
    let help = "the service is exposed too much: the command that failed lists its options";
    steps::output(&mut security, help)?;
    let groups = tree.root().join("usr/lib/gleaner/control-groups.conf");
    if !groups.exists() {
        // It is of the package of vehicles only.
    } else if version.is_some_and(|version| version >= WITH_SUBGROUPS) {
        write_file(&dropin, &moved(tree::read(&groups)?))?;
    } else {
        println!("skipped: control-groups.conf needs systemd {WITH_SUBGROUPS}");
    }
    let mut verify = checkout.command("systemd-analyze");
    verify.args(["verify", "--man=no"]).arg(&unit);
    let output = verify.output().map_err(|error| cannot("verify", &unit, &error))?;
    let remarks = String::from_utf8_lossy(&output.stderr);
    // It succeeds with unknown keys, too. Remarks on other units of this machine do not count.
    if !output.status.success() || remarks.contains("gleaner") {
        let mut failure = Failure::new(Exit::Differs, "systemd does not accept the service");
        failure.causes = remarks.lines().map(str::to_owned).collect();
        let help = format!("mend {}/{}", source.folder, source.unit());
        return Err(failure.with_help(help));
    }
    println!("systemd {}: accepted", version.unwrap_or_default());
    Ok(())
}
