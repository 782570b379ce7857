//! Builds the arguments of the processes of a run.

use std::ffi::{OsStr, OsString};

use gleaner_protocol::ProcessOrigin;

use crate::spec::{LambdaSpec, RunSpec};
use crate::starter;

/// Returns the arguments of the ingress. `largest` is the largest sample of an input, in bytes.
pub(crate) fn ingress(spec: &RunSpec, largest: u64, offset_ns: i64) -> Vec<OsString> {
    let mut line =
        vec![format!("--clock-offset={offset_ns}").into(), format!("--largest={largest}").into()];
    line.extend(spec.drives.iter().map(|drive| option("--drive", drive)));
    line.extend(spec.merge.then(|| "--merge".into()));
    line.extend(spec.rate.map(|rate| format!("--rate={rate}").into()));
    line.extend(spec.network.iter().cloned());
    line
}

pub(crate) fn runtime(
    spec: &RunSpec,
    lambda: &LambdaSpec,
    offset_ns: i64,
    restarts: u32,
) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["run".into(), format!("--clock-offset={offset_ns}").into()];
    line.extend(lambda.settings(spec.vehicle.as_deref()));
    line.push(option("--out", &lambda.out));
    for (flag, topic) in [("--rtt", &spec.rtt), ("--decisions", &spec.decisions)] {
        line.extend(topic.as_ref().map(|topic| option(flag, topic)));
    }
    line.extend((restarts > 0).then(|| format!("--restarts={restarts}").into()));
    line.extend(spec.all.then(|| "--all".into()));
    line.extend(["--".into(), lambda.folder.clone().into()]);
    line
}

pub(crate) fn shim(spec: &RunSpec, lambda: &LambdaSpec, restarts: u32) -> Vec<OsString> {
    let mut line = vec![option("--exit-record", lambda.exit_record()), starter()];
    match (&lambda.deployment, &spec.spool) {
        (Some(deployment), Some((folder, bytes))) => {
            let origin = ProcessOrigin {
                lambda: deployment.id.clone(),
                revision: deployment.revision.clone(),
                generation: deployment.attempt,
                start: restarts,
            };
            let origin = serde_json::to_string(&origin).expect("an origin is plain data");
            line.push(option("--spool", folder.join("lambdas").join(&deployment.id)));
            line.push(option("--origin", origin));
            line.push(format!("--spool-budget={bytes}").into());
        }
        _ => {
            line.push(option("--results", &lambda.out));
            line.extend((restarts > 0).then(|| "--again".into()));
        }
    }
    line.extend(spec.cgroup.as_ref().map(|folder| option("--cgroup", folder)));
    line
}

pub(crate) fn recorder<'a>(
    spec: &RunSpec,
    recorded: impl Iterator<Item = &'a LambdaSpec>,
    offset_ns: i64,
) -> Vec<OsString> {
    let mut line = vec![option("--out", &spec.clips), format!("--clock-offset={offset_ns}").into()];
    line.extend(recorded.map(|lambda| option("--messages", lambda.folder.join("build/msg"))));
    line.extend(spec.commands.as_ref().map(|topic| option("--commands", topic)));
    let signing = spec.signing.as_ref();
    line.extend(signing.map(|signing| option("--vehicle-name", &signing.vehicle)));
    let bounds = [
        ("disk-floor", spec.disk_floor),
        ("clips-max", spec.clips_max),
        ("bytes-max", spec.bytes_max),
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
