//! Real-time priority of the ingress, which no other process gets.

use std::collections::BTreeSet;
use std::fs;
use std::process::Command;

use gleaner_tests::live::{descendants, run};
use gleaner_tests::{TempFolder, root};
use libtest_mimic::Failed;

use crate::DdsCase;

pub const CASES: &[DdsCase] =
    &[DdsCase { name: "the_ingress_alone_has_real_time_priority", needs: &[], run: ingress_alone }];

/// Policies of `sched(7)`, as `/proc/PID/stat` has them.
const NORMAL: &str = "0";
const FIFO: &str = "1";

fn ingress_alone() -> Result<(), Failed> {
    let out = TempFolder::new();
    let lambda = root().join("tests/lambdas/ticker/python");
    let running = run(&lambda, out.path(), &["--no-record", "--real-time"]);
    running.until_ready();
    let permitted = Command::new("chrt").args(["-f", "1", "true"]).status()?.success();
    let of = |name: &str| -> BTreeSet<String> {
        let processes = descendants(running.pid(), name);
        processes.iter().flat_map(|pid| policies(*pid)).collect()
    };
    let expected = if permitted { FIFO } else { NORMAL };
    let (ingress, shim) = (of("gleaner-ingress"), descendants(running.pid(), "gleaner-shim"));
    assert_eq!(ingress, BTreeSet::from([expected.to_owned()]));
    assert!(!shim.is_empty(), "a lambda has a shim");
    for pid in descendants(running.pid(), "") {
        let limits = fs::read_to_string(format!("/proc/{pid}/limits")).unwrap_or_default();
        let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        if name.trim_end() != "gleaner-ingress" {
            assert!(policies(pid).is_subset(&BTreeSet::from([NORMAL.to_owned()])), "{name}");
        }
        let priority = limits.lines().find(|line| line.starts_with("Max realtime priority"));
        let zero = priority.is_none_or(|line| line.split_whitespace().nth(3) == Some("0"));
        assert!(zero, "{name}: {priority:?}");
    }
    running.signal("INT");
    let finished = running.finish();
    assert!(finished.status.success(), "{}", finished.stderr);
    assert_eq!(finished.ended().network.real_time, permitted);
    assert_eq!(finished.stderr.contains("refuses real-time priority"), !permitted);
    Ok(())
}

/// The scheduling policies of the threads of a process.
fn policies(pid: u32) -> BTreeSet<String> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let policy = |thread: fs::DirEntry| {
        let stat = fs::read_to_string(thread.path().join("stat")).ok()?;
        // `policy` is the 41st field; the name, which is the second one, may contain spaces.
        Some(stat.rsplit_once(')')?.1.split_whitespace().nth(38)?.to_owned())
    };
    threads.filter_map(policy).collect()
}
