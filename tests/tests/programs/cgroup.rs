//! A runtime in a control group. The test machines do not delegate one, so a folder stands in for
//! it; the effect of the kernel is not tested.

use std::path::Path;
use std::process::Command;

use gleaner_tests::{LambdaCopy, TempFolder, program, root, sample_drive};

const MIB: u64 = 1 << 20;

/// Script that creates the files of the group that gleaner-shim creates next, as the kernel would,
/// and then becomes gleaner-shim.
const AS_THE_KERNEL: &str = r#"tree=$1; shift
mkdir "$tree/gleaner-$$" && : > "$tree/gleaner-$$/cgroup.procs" && exec "$@""#;

/// Memory limit of the group after a replay by this lambda, with options of gleaner-shim.
fn memory_limit(lambda: &Path, options: &[&str]) -> u64 {
    let (tree, out) = (TempFolder::new(), TempFolder::new());
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
    let output = shim.output().expect("`sh` exists");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let groups = std::fs::read_dir(tree.path()).unwrap().map(|entry| entry.unwrap().path());
    let group = groups.filter(|path| path.is_dir()).collect::<Vec<_>>().pop().expect("a group");
    let text = |file: &str| std::fs::read_to_string(group.join(file)).unwrap();
    assert_eq!(text("cgroup.procs"), "0", "the shim joins the group before it becomes the runtime");
    text("memory.max").parse().unwrap()
}

#[test]
fn the_limit_of_a_control_group_follows_the_manifest() {
    for kind in ["rust", "python"] {
        let with = |memory: &str| {
            let other = |line: &str| {
                if line.starts_with("memory = ") {
                    format!("memory = \"{memory}\"")
                } else {
                    line.to_owned()
                }
            };
            LambdaCopy::of(&format!("tests/lambdas/misbehave/{kind}"), |manifest| {
                manifest.lines().map(|line| other(line) + "\n").collect()
            })
        };
        let (small, large) = (with("64 MiB"), with("96 MiB"));
        let [small_limit, large_limit] =
            [&small, &large].map(|lambda| memory_limit(lambda.path(), &[]));
        // The lambda's memory, and its frames; plus a constant for interpreter, rings and network.
        assert_eq!(large_limit - small_limit, 2 * 32 * MIB, "{kind}");
        assert!((1024 * MIB..2048 * MIB).contains(&small_limit), "{kind}: {small_limit}");
        // An option may lower the limit, never raise it.
        assert_eq!(
            memory_limit(small.path(), &["--cgroup-memory", "536870912"]),
            512 * MIB,
            "{kind}"
        );
    }
}
