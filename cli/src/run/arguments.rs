//! Builds the arguments of the processes of a run.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use crate::args::RunArgs;
use crate::delegate::starter;

/// Returns the runtime's arguments.
pub(super) fn runtime(
    args: &RunArgs,
    has_recorder: bool,
    offset_ns: i64,
    restarts: u32,
) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["run".into(), format!("--clock-offset={offset_ns}").into()];
    line.extend(args.target.settings());
    line.push(option("--out", out(args)));
    for (flag, topic) in [("--rtt", &args.rtt), ("--decisions", &args.decisions)] {
        if let Some(topic) = topic {
            line.push(option(flag, topic));
        }
    }
    if restarts > 0 {
        line.push(format!("--restarts={restarts}").into());
    }
    for (flag, wanted) in [("--all", args.all), ("--recorder", has_recorder)] {
        if wanted {
            line.push(flag.into());
        }
    }
    line.extend(args.network.to_args());
    line.extend(["--".into(), args.target.lambda.clone().into()]);
    line
}

/// Returns the arguments of the runtime's shim.
pub(super) fn shim(args: &RunArgs, exit_record: &Path, restarts: u32) -> Vec<OsString> {
    let mut line =
        vec![option("--exit-record", exit_record), option("--results", out(args)), starter()];
    line.extend((restarts > 0).then(|| "--again".into()));
    line.extend(args.cgroup.as_ref().map(|folder| option("--cgroup", folder)));
    line
}

/// Returns the recorder's arguments. `largest` is the largest sample that it will receive, in
/// bytes.
pub(super) fn recorder(args: &RunArgs, largest: u64, offset_ns: i64) -> Vec<OsString> {
    let mut line = vec![
        option("--out", out(args)),
        option("--messages", args.target.lambda.join("build/msg")),
    ];
    line.push(format!("--clock-offset={offset_ns}").into());
    line.push(format!("--largest={largest}").into());
    line.extend(args.commands.as_ref().map(|topic| option("--commands", topic)));
    let bounds = [
        ("disk-floor", args.disk_floor),
        ("clips-max", args.clips_max),
        ("bytes-max", args.bytes_max),
    ];
    for (flag, bound) in bounds {
        if let Some(bound) = bound {
            line.push(format!("--{flag}={bound}").into());
        }
    }
    line.extend(args.network.to_args());
    line
}

/// Returns the result folder.
pub(super) fn out(args: &RunArgs) -> PathBuf {
    args.out.clone().unwrap_or_else(|| args.target.lambda.join("live"))
}

/// Makes one argument `FLAG=VALUE`, since the value may begin with a minus.
fn option(flag: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut argument = OsString::from(format!("{flag}="));
    argument.push(value);
    argument
}

/// Returns the renamed topics for the recorder. The command line has checked their form.
pub(super) fn remaps(args: &RunArgs) -> Vec<(String, String)> {
    let pairs = args.target.remap.iter().filter_map(|remap| remap.split_once(":="));
    pairs.map(|(from, to)| (from.trim().to_owned(), to.trim().to_owned())).collect()
}
