//! What the processes of a run are told.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use crate::args::RunArgs;
use crate::sibling::starter;

/// The runtime's arguments.
pub(super) fn runtime(
    args: &RunArgs,
    has_recorder: bool,
    offset_ns: i64,
    restarts: u32,
) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["run".into(), format!("--clock-offset={offset_ns}").into()];
    line.extend(args.asked.settings());
    line.push(word("--out", out(args)));
    for (flag, topic) in [("--rtt", &args.rtt), ("--decisions", &args.decisions)] {
        if let Some(topic) = topic {
            line.push(word(flag, topic));
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
    line.extend(["--".into(), args.asked.lambda.clone().into()]);
    line
}

/// The arguments of the runtime's shim.
pub(super) fn shim(args: &RunArgs, exit_record: &Path, restarts: u32) -> Vec<OsString> {
    let mut line =
        vec![word("--exit-record", exit_record), word("--results", out(args)), starter()];
    line.extend((restarts > 0).then(|| "--again".into()));
    line.extend(args.cgroup.as_ref().map(|folder| word("--cgroup", folder)));
    line
}

/// The recorder's arguments. `largest` is the largest sample that it will see, in bytes.
pub(super) fn recorder(args: &RunArgs, largest: u64, offset_ns: i64) -> Vec<OsString> {
    let mut line =
        vec![word("--out", out(args)), word("--messages", args.asked.lambda.join("build/msg"))];
    line.push(format!("--clock-offset={offset_ns}").into());
    line.push(format!("--largest={largest}").into());
    line.extend(args.commands.as_ref().map(|topic| word("--commands", topic)));
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

/// Where the results go.
pub(super) fn out(args: &RunArgs) -> PathBuf {
    args.out.clone().unwrap_or_else(|| args.asked.lambda.join("live"))
}

/// An argument in one word: its value may begin with a minus.
fn word(flag: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut word = OsString::from(format!("{flag}="));
    word.push(value);
    word
}

/// Other names for topics, as the recorder is told of them. They were checked when they were typed.
pub(super) fn remaps(args: &RunArgs) -> Vec<(String, String)> {
    let pairs = args.asked.remap.iter().filter_map(|remap| remap.split_once(":="));
    pairs.map(|(from, to)| (from.trim().to_owned(), to.trim().to_owned())).collect()
}
