//! `gleaner replay DIR DRIVE...` and `gleaner verify CLIP`: run the runtime and print its result.

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, safe_file, visible};
use gleaner_lambda::OutputLock;
use gleaner_protocol::ReplaySummary;
use gleaner_report::{Decisions, clips};
use serde_json::Value;

use crate::args::{ReplayArgs, ReplayedArgs, VerifyArgs};
use crate::output::{print, print_error, print_json, show};
use crate::render::{self, Digest, Paint};
use crate::report;
use crate::runtime::{self, RuntimeResult};
use crate::separate;
use crate::signing;

pub(crate) fn run(args: &ReplayArgs) -> Result<Exit, Failure> {
    results(args).map(|(exit, _)| exit)
}

/// Replays. Returns the exit code of the runtime, and the folders of new results: a lambda that
/// cannot start leaves the earlier ones.
pub(crate) fn results(args: &ReplayArgs) -> Result<(Exit, Vec<PathBuf>), Failure> {
    let target = &args.replayed.target;
    let (mut result, exit) =
        runtime::run(&target.lambda, target.vehicle.as_deref(), arguments(args))?;
    if let Some(RuntimeResult::Separate(drives)) = &result {
        return each(args, drives);
    }
    let folders = result.iter().map(|_| args.replayed.out()).collect();
    if let Some(RuntimeResult::Summary(summary)) = &mut result {
        // Not the path in the report, which may come from the lambda's process.
        summary.out = args.replayed.out();
    }
    let report = match &result {
        Some(RuntimeResult::Summary(summary)) => report_of(&summary.out, args.no_report),
        _ => Ok(None),
    };
    print_result((result, exit), args.json)?;
    match report {
        Ok(Some(path)) if !args.json => {
            print(&format!(
                "  {}\n",
                Paint::of_stdout().dim(&format!("report: {}", visible_path(&path)))
            ))?;
        }
        Ok(_) => {}
        // The results are complete without the report page.
        Err(failure) => {
            eprintln!("{failure}");
            return Ok((if exit == Exit::Ok { Exit::Internal } else { exit }, folders));
        }
    }
    Ok((exit, folders))
}

/// Replays separate drives one by one, each with a fresh lambda.
fn each(args: &ReplayArgs, drives: &[Vec<PathBuf>]) -> Result<(Exit, Vec<PathBuf>), Failure> {
    let out = args.replayed.out();
    let folder = separate::folder(&out);
    safe_file::refuse_linked(&folder, &args.replayed.target.lambda)?;
    let _held = OutputLock::take(&folder)?;
    if out.join("summary.json").exists() {
        let out = visible_path(&out);
        print_error(&format!("note: the results of an earlier replay stay in `{out}`\n"));
    }
    let mut replayed = Vec::new();
    let exit = separate::each(drives, args.json, |drives, name| {
        let out = Some(folder.join(name));
        let one = ReplayedArgs { drives, out, ..args.replayed.clone() };
        let (exit, folders) = results(&ReplayArgs { replayed: one, ..args.clone() })?;
        replayed.extend(folders);
        Ok(exit)
    })?;
    Ok((exit, replayed))
}

fn visible_path(path: &Path) -> String {
    visible(&path.to_string_lossy())
}

/// Writes the report page into `out`, unless `no_report`. The page of an earlier replay is removed
/// in any case, since it is about other results.
fn report_of(out: &Path, no_report: bool) -> Result<Option<PathBuf>, Failure> {
    let path = out.join(report::NAME);
    if let Err(error) = fs::remove_file(&path)
        && error.kind() != io::ErrorKind::NotFound
    {
        let failure = Failure::caused_by(
            Exit::Internal,
            format!("cannot write the report `{}`", path.display()),
            &error,
        );
        return Err(failure.with_help("remove the file: it is from an earlier replay"));
    }
    if no_report { Ok(None) } else { report::write(out).map(Some) }
}

/// Checks the signature of a clip, if vehicles to trust are given, and repeats its decisions.
pub(crate) fn verify(args: &VerifyArgs) -> Result<Exit, Failure> {
    let check = |trust: &PathBuf| signing::check_clip(&args.clip, trust);
    let signed = args.trust.as_ref().map(check).transpose()?;
    if let Some(signed) = signed.as_ref().filter(|_| !args.json) {
        print(&signing::clip_text(signed, Paint::of_stdout()))?;
    }
    let (result, exit) = match &args.lambda {
        None => (None, Exit::Ok),
        Some(lambda) => {
            let mut line = vec!["verify".into(), "--lambda".into(), lambda.into()];
            let vehicle = args.vehicle.iter();
            line.extend(vehicle.flat_map(|file| [OsString::from("--vehicle"), file.into()]));
            line.extend(["--".into(), args.clip.clone().into()]);
            runtime::run(lambda, args.vehicle.as_deref(), line)?
        }
    };
    match (&signed, &result) {
        (Some(signed), None) if args.json => {
            print_json(&signing::clip_json(signed, Value::Null))?;
        }
        (Some(signed), Some(RuntimeResult::Verified(verified))) if args.json => {
            print_json(&signing::clip_json(signed, serde_json::json!(verified)))?;
        }
        _ => return print_result((result, exit), args.json),
    }
    Ok(exit)
}

pub(crate) fn print_result(
    (result, exit): (Option<RuntimeResult>, Exit),
    json: bool,
) -> Result<Exit, Failure> {
    let paint = Paint::of_stdout();
    match result {
        Some(RuntimeResult::Summary(summary)) if json => {
            print_json(&summary)?;
        }
        Some(RuntimeResult::Summary(summary)) => print(&summary_text(&summary)?)?,
        Some(RuntimeResult::Checked(checked)) => {
            show(json, &checked, |checked| render::check_report(checked, paint))?;
        }
        Some(RuntimeResult::Verified(verified)) => {
            show(json, &verified, |verified| render::verified(verified, paint))?;
        }
        // Only a replay reports several drives, which takes them one by one.
        Some(RuntimeResult::Separate(_)) | None => {}
    }
    Ok(exit)
}

fn summary_text(summary: &ReplaySummary) -> Result<String, Failure> {
    let digest = Digest::of(Decisions::open(&summary.out)?, summary.start_ns)?;
    let clips = if summary.recording.clips > 0 { clips(&summary.out)? } else { Vec::new() };
    Ok(render::summary(summary, &digest, &clips, Paint::of_stdout()))
}

/// Returns the arguments of the runtime: those of the command, except the ones about output.
fn arguments(args: &ReplayArgs) -> Vec<OsString> {
    let ReplayedArgs { target, drives, merge, from, to, out, no_record } = &args.replayed;
    let mut line: Vec<OsString> = vec!["replay".into()];
    line.extend(target.settings());
    for (flag, file) in [("--out", out), ("--journal", &args.journal), ("--verify", &args.verify)] {
        if let Some(file) = file {
            line.extend([flag.into(), file.into()]);
        }
    }
    for (flag, time) in [("--from", from), ("--to", to)] {
        line.extend(time.iter().flat_map(|time| [OsString::from(flag), time.into()]));
    }
    line.extend(
        args.topics.iter().flat_map(|pattern| [OsString::from("--topics"), pattern.into()]),
    );
    for (flag, wanted) in [("--merge", *merge), ("--all", args.all), ("--no-record", *no_record)] {
        line.extend(wanted.then(|| flag.into()));
    }
    line.push("--".into());
    line.push(target.lambda.clone().into());
    line.extend(drives.iter().map(|drive| drive.clone().into()));
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::LambdaArgs;

    #[test]
    fn the_runtime_gets_the_arguments_with_the_files_last() {
        let target = LambdaArgs {
            lambda: "-dir".into(),
            set: vec!["x=-1".to_owned()],
            remap: vec!["/a:=/b".to_owned()],
            vehicle: Some("v.toml".into()),
        };
        let replayed = ReplayedArgs {
            target,
            drives: vec!["a.mcap".into(), "b".into()],
            from: Some("12.5".to_owned()),
            to: Some("@7".to_owned()),
            merge: true,
            out: Some("out".into()),
            no_record: true,
        };
        let args = ReplayArgs {
            replayed,
            all: true,
            topics: vec!["*".to_owned(), "/a".to_owned()],
            journal: Some("j".into()),
            verify: None,
            no_report: true,
            json: true,
        };
        let line =
            "replay --set x=-1 --remap /a:=/b --vehicle v.toml --out out --journal j --from 12.5 \
             --to @7 --topics * --topics /a --merge --all --no-record -- -dir a.mcap b"
                .split(' ');
        assert_eq!(arguments(&args), line.collect::<Vec<_>>());
    }
}
