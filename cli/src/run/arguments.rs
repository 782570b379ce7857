//! What the processes of a run are told.

use std::ffi::OsString;
use std::time::Duration;

use crate::args::RunArgs;
use crate::sibling::network;

/// The runtime's arguments.
pub(super) fn runtime(
    args: &RunArgs,
    has_recorder: bool,
    offset_ns: i64,
    left: Option<Duration>,
    restarts: u32,
) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["run".into(), format!("--clock-offset={offset_ns}").into()];
    // A value may begin with a minus, so that name and value are one word.
    let word = |flag: &str, value: &std::ffi::OsStr| {
        let mut word = OsString::from(format!("{flag}="));
        word.push(value);
        word
    };
    for set in &args.set {
        line.extend(["--set".into(), set.into()]);
    }
    for remap in &args.remap {
        line.extend(["--remap".into(), remap.into()]);
    }
    if let Some(out) = &args.out {
        line.push(word("--out", out.as_os_str()));
    }
    for (flag, topic) in [("--rtt", &args.rtt), ("--decisions", &args.decisions)] {
        if let Some(topic) = topic {
            line.push(word(flag, topic.as_ref()));
        }
    }
    if let Some(left) = left {
        line.push(format!("--last={}", left.as_secs().max(1)).into());
    }
    if restarts > 0 {
        line.push(format!("--restarts={restarts}").into());
    }
    for (flag, wanted) in [("--all", args.all), ("--recorder", has_recorder)] {
        if wanted {
            line.push(flag.into());
        }
    }
    line.extend(network(&args.network));
    line.extend(["--".into(), args.lambda.clone().into()]);
    line
}

/// The recorder's arguments. `largest` is the largest sample that it will see, in bytes.
pub(super) fn recorder(args: &RunArgs, largest: u64, offset_ns: i64) -> Vec<OsString> {
    let out = args.out.clone().unwrap_or_else(|| args.lambda.join("live"));
    let mut first = OsString::from("--out=");
    first.push(out);
    let mut line: Vec<OsString> = vec![first];
    line.push(format!("--clock-offset={offset_ns}").into());
    line.push(format!("--largest={largest}").into());
    line.extend(["--messages".into(), args.lambda.join("build/msg").into()]);
    if let Some(topic) = &args.commands {
        line.extend(["--commands".into(), topic.into()]);
    }
    let bounds = [("disk-floor", args.disk_floor), ("clips-max", args.clips_max), ("bytes-max", args.bytes_max)];
    for (flag, bound) in bounds {
        if let Some(bound) = bound {
            line.push(format!("--{flag}={bound}").into());
        }
    }
    line.extend(network(&args.network));
    line
}

/// Other names for topics, as the recorder is told of them. They were checked when they were typed.
pub(super) fn remaps(args: &RunArgs) -> Vec<(String, String)> {
    let pairs = args.remap.iter().filter_map(|remap| remap.split_once(":="));
    pairs.map(|(from, to)| (from.trim().to_owned(), to.trim().to_owned())).collect()
}
