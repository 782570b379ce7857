//! A runtime in a control group. No machine of ours delegates one, so it is a folder that looks
//! like one; what the kernel would do is not there.

use std::path::Path;
use std::process::Command;

use gleaner_tests::{Copy, Folder, program, root, sample_drive};

const MIB: u64 = 1 << 20;

/// Makes the files that the kernel would, of the group that gleaner-shim makes next, and becomes
/// that.
const AS_THE_KERNEL: &str = r#"tree=$1; shift; mkdir "$tree/gleaner-$$" && : > "$tree/gleaner-$$/cgroup.procs" && exec "$@""#;

/// The bound of the group after a replay by this lambda, with options of gleaner-shim.
fn bound(lambda: &Path, options: &[&str]) -> u64 {
    let (tree, out) = (Folder::new(), Folder::new());
    tree.write("cgroup.controllers", "cpu memory pids\n");
    let mut shim = Command::new("sh");
    shim.args(["-c", AS_THE_KERNEL, "sh"])
        .arg(tree.path())
        .arg(program("gleaner-shim"))
        .arg("--cgroup")
        .arg(tree.path());
    shim.args(options)
        .arg("--")
        .arg(program("gleaner-runtime"))
        .arg("replay")
        .arg(lambda)
        .arg(sample_drive());
    shim.arg("--out").arg(out.path()).env("XDG_CACHE_HOME", root().join("target/test-cache"));
    let output = shim.output().expect("there is a `sh`");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let groups = std::fs::read_dir(tree.path()).unwrap().map(|entry| entry.unwrap().path());
    let group = groups.filter(|path| path.is_dir()).collect::<Vec<_>>().pop().expect("a group");
    let text = |file: &str| std::fs::read_to_string(group.join(file)).unwrap();
    assert_eq!(text("cgroup.procs"), "0", "it enters by itself, before it is the runtime");
    text("memory.max").parse().unwrap()
}

#[test]
fn the_bound_of_a_control_group_is_what_the_manifest_lets_a_lambda_take() {
    for kind in ["rust", "python"] {
        let with = |memory: &str| {
            let other = |line: &str| {
                if line.starts_with("memory = ") {
                    format!("memory = \"{memory}\"")
                } else {
                    line.to_owned()
                }
            };
            Copy::of(&format!("tests/lambdas/misbehave/{kind}"), |manifest| {
                manifest.lines().map(|line| other(line) + "\n").collect()
            })
        };
        let (small, large) = (with("64 MiB"), with("96 MiB"));
        let [small_bound, large_bound] = [&small, &large].map(|lambda| bound(lambda.path(), &[]));
        // The lambda, and the frames that it makes; around them interpreter, rings and network.
        assert_eq!(large_bound - small_bound, 2 * 32 * MIB, "{kind}");
        assert!((1024 * MIB..2048 * MIB).contains(&small_bound), "{kind}: {small_bound}");
        // Who starts it may allow less, and never more.
        assert_eq!(bound(small.path(), &["--cgroup-memory", "536870912"]), 512 * MIB, "{kind}");
    }
}
