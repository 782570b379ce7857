//! The base layer: denies what no lambda's process ever needs, such as access to other processes,
//! changes to the system and changes of user.

use gleaner_protocol::Layer;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use rustix::thread::{
    CapabilitySet, CapabilitySets, capabilities, remove_capability_from_bounding_set,
    set_capabilities,
};

use crate::filter::{DeniedCalls, install};
use crate::priority::leave_real_time;
use crate::{JailError, layer};

pub const NAME: &str = "system calls";
/// The name of the layer of a process that has to keep the priority of its starter.
const REAL_TIME: &str = "real-time priority";

/// Flags of `clone` that create namespaces, in which a process would gain privileges.
const NAMESPACES: [i32; 7] = [
    libc::CLONE_NEWNS,
    libc::CLONE_NEWCGROUP,
    libc::CLONE_NEWUTS,
    libc::CLONE_NEWIPC,
    libc::CLONE_NEWUSER,
    libc::CLONE_NEWPID,
    libc::CLONE_NEWNET,
];

// Newer than the lists of `libc`; the numbers are the same on every architecture.
const QUOTACTL_FD: i64 = 443;
const PROCESS_MRELEASE: i64 = 448;
const OPEN_TREE_ATTR: i64 = 467;

const CALLS: &[i64] = &[
    // Other processes' memory and files.
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_process_madvise,
    libc::SYS_kcmp,
    libc::SYS_move_pages,
    libc::SYS_migrate_pages,
    PROCESS_MRELEASE,
    // The kernel, and parts of it with a history of holes.
    libc::SYS_bpf,
    libc::SYS_perf_event_open,
    libc::SYS_userfaultfd,
    libc::SYS_io_uring_setup,
    libc::SYS_io_uring_enter,
    libc::SYS_io_uring_register,
    libc::SYS_add_key,
    libc::SYS_request_key,
    libc::SYS_keyctl,
    libc::SYS_init_module,
    libc::SYS_finit_module,
    libc::SYS_delete_module,
    libc::SYS_kexec_load,
    libc::SYS_kexec_file_load,
    libc::SYS_syslog,
    libc::SYS_lookup_dcookie,
    libc::SYS_personality,
    // The system.
    libc::SYS_mount,
    libc::SYS_umount2,
    libc::SYS_pivot_root,
    libc::SYS_chroot,
    libc::SYS_move_mount,
    libc::SYS_open_tree,
    libc::SYS_fsopen,
    libc::SYS_fsconfig,
    libc::SYS_fsmount,
    libc::SYS_fspick,
    libc::SYS_mount_setattr,
    libc::SYS_unshare,
    libc::SYS_setns,
    libc::SYS_name_to_handle_at,
    libc::SYS_open_by_handle_at,
    libc::SYS_quotactl,
    QUOTACTL_FD,
    OPEN_TREE_ATTR,
    libc::SYS_acct,
    libc::SYS_swapon,
    libc::SYS_swapoff,
    libc::SYS_reboot,
    libc::SYS_sethostname,
    libc::SYS_setdomainname,
    libc::SYS_settimeofday,
    libc::SYS_clock_settime,
    libc::SYS_clock_adjtime,
    libc::SYS_adjtimex,
    libc::SYS_vhangup,
    // Another user.
    libc::SYS_setuid,
    libc::SYS_setgid,
    libc::SYS_setreuid,
    libc::SYS_setregid,
    libc::SYS_setresuid,
    libc::SYS_setresgid,
    libc::SYS_setfsuid,
    libc::SYS_setfsgid,
    libc::SYS_setgroups,
    libc::SYS_capset,
];

#[cfg(target_arch = "x86_64")]
const MACHINE_CALLS: &[i64] =
    &[libc::SYS_iopl, libc::SYS_ioperm, libc::SYS_modify_ldt, libc::SYS_uselib];
#[cfg(not(target_arch = "x86_64"))]
const MACHINE_CALLS: &[i64] = &[];

/// Applies these limits to this process, which has one thread, and its descendants. Returns the
/// layers; that of real-time priority only if this process has to keep it.
pub fn apply() -> Vec<Layer> {
    let kept = leave_real_time().err().map(|error| Layer::no(REAL_TIME, error.to_string()));
    kept.into_iter().chain(apply_at_any_priority()).collect()
}

/// As [`apply`], for a process that may have real-time priority.
pub(crate) fn apply_at_any_priority() -> Vec<Layer> {
    forbid_real_time();
    vec![
        no_new_privileges(),
        drop_capabilities(),
        no_core_files(),
        limit_open_files(),
        deny_calls(),
    ]
}

/// Forbids to take real-time priority, which the starter may have for the ingress: a lambda that
/// has it would take a core from everyone else.
fn forbid_real_time() {
    // Lowering a limit is never refused.
    let _ = setrlimit(Resource::Rtprio, Rlimit { current: Some(0), maximum: Some(0) });
}

/// Drops the capabilities of root, and of users who were granted some. Those on files are kept: in
/// a container root often writes into folders of other users, and Landlock restricts the files.
fn drop_capabilities() -> Layer {
    const NAME: &str = "capabilities";
    const KEPT: CapabilitySet = CapabilitySet::DAC_OVERRIDE.union(CapabilitySet::DAC_READ_SEARCH);
    let given_up = || {
        let had = capabilities(None)?;
        if had.permitted.is_empty() {
            return Ok(had.permitted);
        }
        for power in CapabilitySet::all().difference(KEPT).iter() {
            // A capability that this kernel lacks cannot be dropped. Where dropping is not
            // permitted, no_new_privs keeps the capability from coming back.
            let _ = remove_capability_from_bounding_set(power);
        }
        let (effective, permitted) = (had.effective & KEPT, had.permitted & KEPT);
        set_capabilities(
            None,
            CapabilitySets { effective, permitted, inheritable: CapabilitySet::empty() },
        )?;
        Ok(capabilities(None)?.permitted)
    };
    let given_up: rustix::io::Result<CapabilitySet> = given_up();
    match given_up {
        Ok(left) if left.is_empty() => Layer::yes(NAME, "none"),
        Ok(left) if KEPT.contains(left) => {
            Layer::yes(NAME, "dropped, except to read and write files of other users")
        }
        Ok(_) => Layer::no(NAME, "could not be given up"),
        Err(error) => Layer::no(NAME, error.to_string()),
    }
}

fn no_new_privileges() -> Layer {
    let note = "no_new_privs: setuid programs gain nothing";
    layer("new privileges", note, rustix::thread::set_no_new_privs(true))
}

/// Disables core files, which other users may read: they contain the data that a lambda processed.
fn no_core_files() -> Layer {
    let none = Rlimit { current: Some(0), maximum: Some(0) };
    layer("core files", "disabled", setrlimit(Resource::Core, none))
}

/// Limits open files: each descriptor takes kernel memory, which no other limit counts. The soft
/// limit is the usual one at most, whatever the starter has.
fn limit_open_files() -> Layer {
    const NAME: &str = "open files";
    const MOST: u64 = 4096;
    const USUAL: u64 = 1024;
    let limited = limit_files(MOST).and_then(|most| {
        let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
        let current = current.map(|current| current.min(USUAL));
        setrlimit(Resource::Nofile, Rlimit { current, maximum })?;
        Ok(most)
    });
    match limited {
        Ok(most) => Layer::yes(NAME, format!("at most {most}; fewer while a lambda runs")),
        Err(error) => Layer::no(NAME, error.to_string()),
    }
}

/// Limits this process to `more` open files beyond those that it has. Where these cannot be
/// counted, the limit stays.
pub(crate) fn limit_open_files_beyond(more: u64) {
    let highest = std::fs::read_dir("/proc/self/fd").ok().and_then(|open| {
        open.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse::<u64>().ok()).max()
    });
    if let Some(highest) = highest {
        // Lowering a limit is never refused.
        let _ = limit_files(highest.saturating_add(more));
    }
}

fn limit_files(max_files: u64) -> rustix::io::Result<u64> {
    let now = getrlimit(Resource::Nofile);
    let max_files = now.maximum.map_or(max_files, |maximum| maximum.min(max_files));
    let current = now.current.map_or(max_files, |current| current.min(max_files));
    setrlimit(Resource::Nofile, Rlimit { current: Some(current), maximum: Some(max_files) })?;
    Ok(max_files)
}

fn deny_calls() -> Layer {
    let note =
        "seccomp denies other processes' memory, namespaces, mounts, keys, modules, time, users";
    layer(NAME, note, install_both().map_err(|error| error.chain()))
}

fn install_both() -> Result<(), JailError> {
    let mut refused = DeniedCalls::default().calls(CALLS).calls(MACHINE_CALLS);
    for flag in NAMESPACES {
        let flag = u64::from(flag.unsigned_abs());
        refused = refused.bits(libc::SYS_clone, 0, flag, flag);
    }
    install(&DeniedCalls::no_clone3()?)?;
    install(&refused.filter(libc::EPERM)?)
}
