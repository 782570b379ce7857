//! Builds the arguments of the processes of a run.

use std::ffi::{OsStr, OsString};

use super::lambdas::{self, RunLambda};
use crate::args::RunArgs;
use crate::delegate::starter;

/// Returns the arguments of the ingress. `largest` is the largest sample of an input, in bytes.
pub(super) fn ingress(args: &RunArgs, largest: u64, offset_ns: i64) -> Vec<OsString> {
    let mut line =
        vec![format!("--clock-offset={offset_ns}").into(), format!("--largest={largest}").into()];
    line.extend(args.drive.iter().map(|drive| option("--drive", drive)));
    line.extend(args.rate.map(|rate| format!("--rate={rate}").into()));
    line.extend(args.network.to_args());
    line
}

/// Returns the arguments of a lambda's runtime.
pub(super) fn runtime(
    args: &RunArgs,
    lambda: &RunLambda,
    offset_ns: i64,
    restarts: u32,
) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["run".into(), format!("--clock-offset={offset_ns}").into()];
    line.extend(lambda.settings(args.vehicle.as_deref()));
    line.push(option("--out", &lambda.out));
    for (flag, topic) in [("--rtt", &args.rtt), ("--decisions", &args.decisions)] {
        line.extend(topic.as_ref().map(|topic| option(flag, topic)));
    }
    line.extend((restarts > 0).then(|| format!("--restarts={restarts}").into()));
    line.extend(args.all.then(|| "--all".into()));
    line.extend(["--".into(), lambda.folder.clone().into()]);
    line
}

/// Returns the arguments of the runtime's shim.
pub(super) fn shim(args: &RunArgs, lambda: &RunLambda, restarts: u32) -> Vec<OsString> {
    let mut line = vec![
        option("--exit-record", lambda.exit_record()),
        option("--results", &lambda.out),
        starter(),
    ];
    line.extend((restarts > 0).then(|| "--again".into()));
    line.extend(args.cgroup.as_ref().map(|folder| option("--cgroup", folder)));
    line
}

/// Returns the recorder's arguments.
pub(super) fn recorder<'a>(
    args: &RunArgs,
    recorded: impl Iterator<Item = &'a RunLambda>,
    offset_ns: i64,
) -> Vec<OsString> {
    let mut line =
        vec![option("--out", lambdas::out(args)), format!("--clock-offset={offset_ns}").into()];
    line.extend(recorded.map(|lambda| option("--messages", lambda.folder.join("build/msg"))));
    line.extend(args.commands.as_ref().map(|topic| option("--commands", topic)));
    let bounds = [
        ("disk-floor", args.disk_floor),
        ("clips-max", args.clips_max),
        ("bytes-max", args.bytes_max),
    ];
    for (flag, bound) in bounds {
        line.extend(bound.map(|bound| format!("--{flag}={bound}").into()));
    }
    line
}

/// Makes one argument `FLAG=VALUE`, since the value may begin with a minus.
fn option(flag: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut argument = OsString::from(format!("{flag}="));
    argument.push(value);
    argument
}
