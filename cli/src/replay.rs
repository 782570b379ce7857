//! `gleaner replay DIR DRIVE...` and `gleaner verify CLIP`: what the runtime is asked for, and what
//! people see of its result.

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::Summary;
use gleaner_report::{Decisions, clips};

use crate::args::{ReplayArgs, VerifyArgs};
use crate::report;
use crate::runtime::{self, Heard};
use crate::say::say;
use crate::show::{self, Digest, Paint};

/// Replays, and ends as the runtime ends.
pub(crate) fn run(args: &ReplayArgs) -> Result<Exit, Failure> {
    results(args).map(|(exit, _)| exit)
}

/// Replays. How the runtime ended, and whether there are results of this replay: a lambda that
/// could not start leaves those of before.
pub(crate) fn results(args: &ReplayArgs) -> Result<(Exit, bool), Failure> {
    let (mut heard, exit) = runtime::run(&args.asked.lambda, arguments(args))?;
    let has_results = heard.is_some();
    if let Some(Heard::Summary(summary)) = &mut heard {
        // Not where the report says, which may come from the lambda's process.
        summary.out = args.out.clone().unwrap_or_else(|| args.asked.lambda.join("out"));
    }
    let report = match &heard {
        Some(Heard::Summary(summary)) => report_of(&summary.out, args.no_report),
        _ => Ok(None),
    };
    show_result((heard, exit), args.json)?;
    match report {
        Ok(Some(path)) if !args.json => {
            say(&format!(
                "  {}\n",
                Paint::of_stdout().dim(&format!("report: {}", path.display()))
            ))?;
        }
        Ok(_) => {}
        // The results are whole without it.
        Err(failure) => {
            eprintln!("{failure}");
            return Ok((if exit == Exit::Ok { Exit::Internal } else { exit }, has_results));
        }
    }
    Ok((exit, has_results))
}

/// Writes the report of `out`, unless it was declined. That of an earlier replay goes in any case:
/// it is about other results.
fn report_of(out: &Path, is_declined: bool) -> Result<Option<PathBuf>, Failure> {
    let path = out.join(report::NAME);
    if let Err(error) = fs::remove_file(&path)
        && error.kind() != io::ErrorKind::NotFound
    {
        let failure = Failure::caused_by(
            Exit::Internal,
            format!("cannot write the report `{}`", path.display()),
            &error,
        );
        return Err(failure.with_help("remove what is there: it is not about this replay"));
    }
    if is_declined { Ok(None) } else { report::write(out).map(Some) }
}

/// Makes the decisions in a clip again.
pub(crate) fn verify(args: &VerifyArgs) -> Result<Exit, Failure> {
    let mut line = vec!["verify".into(), "--lambda".into(), args.lambda.clone().into()];
    line.extend(args.vehicle.iter().flat_map(|file| [OsString::from("--vehicle"), file.into()]));
    line.extend(["--".into(), args.clip.clone().into()]);
    show_result(runtime::run(&args.lambda, line)?, args.json)
}

/// Shows what the runtime reported last, and ends as it ended.
pub(crate) fn show_result(
    (heard, exit): (Option<Heard>, Exit),
    json: bool,
) -> Result<Exit, Failure> {
    let text = match heard {
        None => return Ok(exit),
        Some(Heard::Summary(summary)) if json => show::json_line(&summary),
        Some(Heard::Verified(verified)) if json => show::json_line(&verified),
        Some(Heard::Checked(checked)) if json => show::json_line(&checked),
        Some(Heard::Checked(checked)) => show::checked(&checked, Paint::of_stdout()),
        Some(Heard::Summary(summary)) => summary_text(&summary)?,
        Some(Heard::Verified(verified)) => show::verified(&verified, Paint::of_stdout()),
    };
    say(&text)?;
    Ok(exit)
}

fn summary_text(summary: &Summary) -> Result<String, Failure> {
    let digest = Digest::of(Decisions::open(&summary.out)?, summary.start_ns)?;
    let clips = if summary.recording.clips > 0 { clips(&summary.out)? } else { Vec::new() };
    Ok(show::summary(summary, &digest, &clips, Paint::of_stdout()))
}

/// The runtime's arguments: ours, less what only concerns showing.
fn arguments(args: &ReplayArgs) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["replay".into()];
    line.extend(args.asked.settings());
    for (flag, file) in
        [("--out", &args.out), ("--journal", &args.journal), ("--verify", &args.verify)]
    {
        if let Some(file) = file {
            line.extend([flag.into(), file.into()]);
        }
    }
    for (flag, time) in [("--from", &args.from), ("--to", &args.to)] {
        line.extend(time.iter().flat_map(|time| [OsString::from(flag), time.into()]));
    }
    line.extend(
        args.topics.iter().flat_map(|pattern| [OsString::from("--topics"), pattern.into()]),
    );
    for (flag, wanted) in [("--all", args.all), ("--no-record", args.no_record)] {
        if wanted {
            line.push(flag.into());
        }
    }
    line.push("--".into());
    line.push(args.asked.lambda.clone().into());
    line.extend(args.drives.iter().map(|drive| drive.clone().into()));
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::AskedArgs;

    #[test]
    fn the_runtime_gets_our_arguments_with_the_files_last() {
        let args = ReplayArgs {
            asked: AskedArgs {
                lambda: "-dir".into(),
                set: vec!["x=-1".to_owned()],
                remap: vec!["/a:=/b".to_owned()],
                vehicle: Some("v.toml".into()),
            },
            drives: vec!["a.mcap".into(), "b".into()],
            from: Some("12.5".to_owned()),
            to: Some("@7".to_owned()),
            out: Some("out".into()),
            all: true,
            no_record: true,
            topics: vec!["*".to_owned(), "/a".to_owned()],
            journal: Some("j".into()),
            verify: None,
            no_report: true,
            json: true,
        };
        let line =
            "replay --set x=-1 --remap /a:=/b --vehicle v.toml --out out --journal j --from 12.5 --to @7 --topics * --topics /a --all --no-record -- -dir a.mcap b".split(' ');
        assert_eq!(arguments(&args), line.collect::<Vec<_>>());
    }
}
