//! Checks the service of a vehicle: `gleaner-orchestrator`, its folders, its trust root and time.

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use gleaner_base::{ByteSize, Failure, format_duration};
use gleaner_protocol::supervision::SupervisorStatus;
use gleaner_protocol::vehicle_api::{TrustStatus, VehicleStatus};
use gleaner_report::format::size;

use super::Finding;
use crate::args::VehicleArgs;
use crate::since_1970;
use crate::vehicle::VehicleClient;

/// Places of the service as its package installs it.
const STATE: &str = "/var/lib/gleaner";
const UNIT: &str = "gleaner.service";
/// Control groups that are delegated with `control-groups.conf`.
const GROUPS: &str = "/sys/fs/cgroup/system.slice/gleaner.service/lambdas";
/// Longest wait for the orchestrator.
const ANSWER: Duration = Duration::from_secs(5);
/// Free space below which clips and logs soon fail.
const DISK_LOW: ByteSize = ByteSize::gib(1);
/// Remaining time of a trust root from which the next one should be signed.
const EXPIRES_SOON: u64 = 30 * DAY;
const DAY: u64 = 86_400;

/// Returns the findings on the vehicle's service; one if this machine has none.
pub(super) fn findings() -> Vec<Finding> {
    let args = VehicleArgs { run_dir: None, json: false };
    let client = match VehicleClient::new(&args) {
        Ok(client) => client,
        Err(failure) => return vec![unreachable("gleaner-orchestrator", failure)],
    };
    let socket = VehicleClient::socket(&args);
    let unit = systemctl("is-enabled");
    let state = fs::metadata(STATE).ok();
    // The folder of the socket may be closed for this user.
    let has_socket = fs::metadata(&socket)
        .map_or_else(|error| error.kind() == io::ErrorKind::PermissionDenied, |_| true);
    if !has_socket && unit.is_none() && state.is_none() && !is_chosen() {
        let text = "no service on this machine; `gleaner run` needs none";
        return vec![Finding::ok("vehicle", text)];
    }
    let mut findings = vec![clock(since_1970().as_secs(), built())];
    findings.extend(unit.as_deref().map(service));
    findings.extend(socket.parent().and_then(|folder| fs::metadata(folder).ok()).map(group));
    findings.extend(state.as_ref().map(folder));
    findings.extend(state.and_then(|_| rustix::fs::statvfs(STATE).ok()).map(|disk| {
        let [free, whole] = [disk.f_bavail, disk.f_blocks].map(|it| it * disk.f_frsize);
        space(free, whole)
    }));
    match answer(client, &socket) {
        Ok(status) => findings.extend(running(&status)),
        Err(failure) => findings.push(unreachable("gleaner-orchestrator", failure)),
    }
    if unit.is_some() {
        findings.push(control_groups(Path::new("/sys/fs/cgroup"), Path::new(GROUPS)));
    }
    findings
}

/// The findings on an orchestrator that answers.
fn running(status: &VehicleStatus) -> Vec<Finding> {
    let orchestrator = &status.orchestrator;
    let up = uptime(orchestrator.up_s);
    vec![
        Finding::ok("gleaner-orchestrator", format!("version {}, {up}", orchestrator.version)),
        supervisor(status.supervisor.as_ref()),
        trust(status.trust.as_ref(), since_1970().as_secs()),
    ]
}

fn supervisor(status: Option<&SupervisorStatus>) -> Finding {
    const SUBJECT: &str = "gleaner-supervisor";
    match status {
        Some(status) => Finding::ok(SUBJECT, uptime(status.up_s)),
        None => Finding::warning(
            SUBJECT,
            "the orchestrator has no connection to it: no lambda is watched",
            "`gleaner events` and `journalctl -u gleaner` show the reason",
        ),
    }
}

fn trust(trust: Option<&TrustStatus>, now: u64) -> Finding {
    const SUBJECT: &str = "trust root";
    let next = "sign the next one, `gleaner trust new NEXT --after FILE`, and install it: `gleaner \
                trust install NEXT`";
    let Some(trust) = trust else {
        let text = "none is installed: nothing can be deployed";
        return Finding::warning(SUBJECT, text, "`gleaner trust install FILE`");
    };
    let (version, left) = (trust.version, trust.expires.saturating_sub(now));
    if trust.is_expired {
        let text = format!("number {version} has expired: nothing new is accepted");
        return Finding::warning(SUBJECT, text, next);
    }
    let text = format!("number {version}, for {} more days", left / DAY);
    if left < EXPIRES_SOON {
        return Finding::warning(SUBJECT, text, next);
    }
    Finding::ok(SUBJECT, text)
}

/// Compares the clock with the time at which this program was built.
fn clock(now: u64, built: u64) -> Finding {
    const SUBJECT: &str = "clock";
    if now >= built {
        return Finding::ok(SUBJECT, "set");
    }
    let days = (built - now) / DAY;
    Finding::warning(
        SUBJECT,
        format!("{days} days before the build of this program: it is not set"),
        "set it, `timedatectl set-ntp true`; until then, expired signatures may be accepted",
    )
}

/// The state of the unit, as `systemctl is-enabled` prints it.
fn service(state: &str) -> Finding {
    const SUBJECT: &str = "service";
    match state {
        "enabled" | "enabled-runtime" | "static" => Finding::ok(SUBJECT, "starts with the machine"),
        "masked" | "masked-runtime" => {
            let help =
                "`sudo systemctl unmask gleaner`, then `sudo systemctl enable --now gleaner`";
            Finding::warning(SUBJECT, "masked: it cannot be started", help)
        }
        _ => Finding::warning(
            SUBJECT,
            "does not start with the machine",
            "`sudo systemctl enable --now gleaner`",
        ),
    }
}

/// Checks whether this user may enter the run folder.
fn group(run: Metadata) -> Finding {
    let groups = rustix::process::getgroups().unwrap_or_default();
    let own = [rustix::process::getegid()];
    let is_member = groups.iter().chain(&own).any(|group| group.as_raw() == run.gid());
    let user = rustix::process::geteuid().as_raw();
    access(user == 0 || user == run.uid() || is_member || run.mode() & 0o001 != 0)
}

fn access(is_allowed: bool) -> Finding {
    const SUBJECT: &str = "group";
    if is_allowed {
        return Finding::ok(SUBJECT, "this user may control the vehicle");
    }
    Finding::warning(
        SUBJECT,
        "this user is not in the group of the service",
        "`sudo usermod -aG gleaner $USER`, then log in again",
    )
}

/// Checks that only its user can enter the state folder.
fn folder(state: &Metadata) -> Finding {
    const SUBJECT: &str = "state folder";
    let mode = state.mode() & 0o777;
    if mode & 0o077 == 0 {
        return Finding::ok(SUBJECT, format!("{STATE}, private"));
    }
    Finding::warning(
        SUBJECT,
        format!("{STATE} has mode {mode:o}: other users can read clips and keys of accepted files"),
        format!("`sudo chmod 700 {STATE}`"),
    )
}

fn space(free: u64, whole: u64) -> Finding {
    const SUBJECT: &str = "disk";
    let text = format!("{} of {} free for the state", size(free), size(whole));
    if free >= DISK_LOW.bytes() {
        return Finding::ok(SUBJECT, text);
    }
    let help = "free space, or bound clips by `bytes_max` in [recording] of vehicle.toml";
    Finding::warning(SUBJECT, text, help)
}

/// Checks whether control groups are delegated. `root` is the tree of all groups.
fn control_groups(root: &Path, delegated: &Path) -> Finding {
    const SUBJECT: &str = "control groups";
    if !root.join("cgroup.controllers").exists() {
        let text = "not version 2: memory of a lambda is bounded by other means only";
        let help = "boot with `systemd.unified_cgroup_hierarchy=1`";
        return Finding::warning(SUBJECT, text, help);
    }
    let controllers = fs::read_to_string(delegated.join("cgroup.controllers")).unwrap_or_default();
    let has = |name: &str| controllers.split_whitespace().any(|it| it == name);
    if has("memory") && has("pids") {
        return Finding::ok(SUBJECT, "delegated to the service");
    }
    let help = "with systemd 254 or newer, install control-groups.conf: see docs/vehicle.md";
    Finding::warning(SUBJECT, "not delegated to the service", help)
}

fn unreachable(subject: &'static str, failure: Failure) -> Finding {
    let causes = failure.causes.iter().map(|cause| format!(": {cause}")).collect::<String>();
    let help = failure.help.unwrap_or_else(|| "`journalctl -u gleaner` shows its log".to_owned());
    Finding::warning(subject, format!("{}{causes}", failure.message), help)
}

/// Requests the status. A program that hangs must not make this one hang.
fn answer(client: VehicleClient, socket: &Path) -> Result<VehicleStatus, Failure> {
    let (sender, receiver) = mpsc::channel();
    // Its answer is dropped if it comes too late.
    thread::spawn(move || drop(sender.send(client.status())));
    receiver.recv_timeout(ANSWER).unwrap_or_else(|_| {
        let message =
            format!("no answer at `{}` within {}", socket.display(), format_duration(ANSWER));
        Err(Failure::new(gleaner_base::Exit::Unreachable, message))
    })
}

/// Returns the answer of `systemctl` about the unit; `None` without systemd or the unit.
fn systemctl(question: &str) -> Option<String> {
    let output = Command::new("systemctl").args([question, UNIT]).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    // It prints nothing, or `not-found`, if there is no such unit.
    Some(text).filter(|text| !text.is_empty() && text != "not-found")
}

/// Returns whether the user has named the folder of an orchestrator.
fn is_chosen() -> bool {
    std::env::var_os("GLEANER_RUN").is_some_and(|folder| !folder.is_empty())
}

/// The time at which this program was built: that of its file, in s since 1970.
fn built() -> u64 {
    let file = std::env::current_exe().and_then(fs::metadata);
    file.map_or(0, |file| file.mtime().try_into().unwrap_or(0))
}

fn uptime(seconds: f64) -> String {
    format!("up {}", format_duration(Duration::from_secs(seconds.max(0.0) as u64)))
}

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::*;

    const NOW: u64 = 1_800_000_000;

    fn root(days: u64) -> TrustStatus {
        TrustStatus { version: 3, expires: NOW + days * DAY, is_expired: days == 0 }
    }

    #[test]
    fn a_trust_root_must_be_installed_and_last_for_another_month() {
        assert_eq!(trust(Some(&root(90)), NOW).detail, "number 3, for 90 more days");
        assert_eq!(trust(Some(&root(90)), NOW).state, Severity::Ok);
        for (status, expected) in [
            (None, "none is installed: nothing can be deployed"),
            (Some(root(29)), "number 3, for 29 more days"),
            (Some(root(0)), "number 3 has expired: nothing new is accepted"),
        ] {
            let finding = trust(status.as_ref(), NOW);
            assert_eq!((finding.state, finding.detail.as_str()), (Severity::Warning, expected));
            assert!(finding.help.unwrap().contains("gleaner trust install"));
        }
    }

    #[test]
    fn a_clock_before_the_build_is_not_set() {
        assert_eq!(clock(NOW, NOW).state, Severity::Ok);
        let finding = clock(NOW - 10 * DAY, NOW);
        assert_eq!(finding.state, Severity::Warning);
        assert!(finding.detail.starts_with("10 days before the build"), "{}", finding.detail);
    }

    #[test]
    fn a_service_that_does_not_start_with_the_machine_is_reported_with_the_command() {
        assert_eq!(service("enabled").state, Severity::Ok);
        for state in ["disabled", "indirect"] {
            let help = service(state).help.unwrap();
            assert_eq!(help, "`sudo systemctl enable --now gleaner`");
        }
        assert!(service("masked").help.unwrap().contains("unmask"));
    }

    #[test]
    fn little_space_and_missing_rights_are_reported() {
        assert_eq!(space(2 << 30, 8 << 30).state, Severity::Ok);
        assert!(space(1 << 20, 8 << 30).help.unwrap().contains("bytes_max"));
        assert_eq!(access(true).state, Severity::Ok);
        assert!(access(false).help.unwrap().contains("log in again"));
        assert_eq!(supervisor(None).state, Severity::Warning);
    }

    #[test]
    fn control_groups_need_version_2_and_both_controllers() {
        let folder = tempfile::tempdir().unwrap();
        let groups = folder.path().join("lambdas");
        fs::create_dir(&groups).unwrap();
        let check = || control_groups(folder.path(), &groups);
        assert!(check().detail.contains("not version 2"));
        fs::write(folder.path().join("cgroup.controllers"), "cpu memory pids\n").unwrap();
        assert_eq!(check().detail, "not delegated to the service");
        fs::write(groups.join("cgroup.controllers"), "memory\n").unwrap();
        assert_eq!(check().state, Severity::Warning);
        fs::write(groups.join("cgroup.controllers"), "memory pids\n").unwrap();
        assert_eq!(check().state, Severity::Ok);
    }
}
