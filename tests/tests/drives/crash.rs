//! Kills the recorder at any moment: listed clips are complete, and no file with a final name is
//! broken.
//!
//! `GLEANER_KILLS` sets how often the process is killed; the default is 25.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_drives::Replay;
use gleaner_lambda::Clip;
use gleaner_messages::transport::{TopicSpec, Transport};
use gleaner_recorder::RecordingFolder as Clips;
use gleaner_test_support::drives::DiscardSink;
use gleaner_test_support::random::XorShift64;
use gleaner_tests::{LambdaCopy, TempFolder, program, root, runtime, sample_drive, times};
use libtest_mimic::{Failed, Trial};

use crate::clips::needing;

/// Events throughout the drive, so that clips begin and end at many times.
const EVENTS: &str = "event_s=2,8,14,20,26,32,38";

pub fn trials() -> Vec<Trial> {
    let mut trials = vec![
        Trial::test("a_recorder_killed_at_any_moment_leaves_nothing_broken", || killed("ram")),
        Trial::test(
            "a_recorder_with_its_preroll_on_disk_killed_at_any_moment_leaves_nothing_broken",
            || killed("disk"),
        ),
    ];
    let name = "clips_of_a_replay_killed_while_replacing_them_are_not_listed_by_the_next";
    trials.push(Trial::test(name, killed_while_replacing));
    let name = "a_full_disk_is_reported_and_leaves_nothing_broken";
    trials.push(needing(name, can_mount(), |()| full_disk()));
    trials
}

/// `alarm`, with short windows, so that there are several clips.
fn alarm(store: &str) -> LambdaCopy {
    LambdaCopy::of("tests/lambdas/alarm/rust", |manifest| {
        let manifest = manifest
            .replace("preroll = \"5s\"", "preroll = \"2s\"")
            .replace("postroll = \"5s\"", "postroll = \"2s\"");
        manifest.replace("[record]", &format!("[record]\nstore = \"{store}\""))
    })
}

fn replay(lambda: &Path, out: &Path) -> Command {
    let mut replay = runtime();
    replay.arg("replay").arg(lambda).arg(sample_drive()).args(["--set", EVENTS, "--out"]).arg(out);
    replay.stdout(Stdio::null()).stderr(Stdio::null());
    replay
}

fn killed(store: &str) -> Result<(), Failed> {
    let lambda = alarm(store);
    let out = TempFolder::new();
    // The first run compiles the lambda.
    replay(lambda.path(), out.path()).status()?;
    // A run that is delayed would put most kills after the end.
    let mut duration = Duration::MAX;
    for _ in 0..3 {
        let started = Instant::now();
        replay(lambda.path(), out.path()).status()?;
        duration = duration.min(started.elapsed());
    }
    let kills = times("GLEANER_KILLS", 25);
    let mut seen = [0_u32; 3];
    let mut out = TempFolder::new();
    // The times differ, and are the same in each run.
    let mut random = XorShift64(0x9e37_79b9_7f4a_7c15);
    let mut killed = 0;
    // Kills outside of the recording show nothing: continue until some hit it.
    while killed < kills || killed < 10 * kills && (seen[0] == 0 || seen[1] == 0) {
        let kill = killed;
        killed += 1;
        // Every third kill meets the state that the two before it left, so recovery is killed too.
        if kill % 3 == 0 {
            out = TempFolder::new();
        }
        let mut child = replay(lambda.path(), out.path()).spawn()?;
        thread::sleep(duration / 1000 * random.below(1000) as u32);
        child.kill()?;
        child.wait()?;
        let with_context = |why: Failed| {
            Failed::from(format!("kill {kill}: {}", why.message().unwrap_or_default()))
        };
        for clip in listed(out.path())? {
            is_complete(&out.path().join(&clip.file)).map_err(with_context)?;
        }
        if kill % 3 < 2 {
            continue;
        }
        let found = inspect(out.path()).map_err(with_context)?;
        seen[0] += u32::from(found.listed > 0);
        seen[1] += u32::from(found.recovered > 0);
        seen[2] += found.recovered as u32;
    }
    println!(
        "{store}: {killed} kills, three in each folder: {} folders had listed clips, \
         {} clips to recover, {} clips",
        seen[0], seen[1], seen[2]
    );
    if seen[0] == 0 || seen[1] == 0 {
        return Err(format!("no kill hit a running recorder: {seen:?}").into());
    }
    Ok(())
}

/// Clips of an earlier replay that a kill leaves half deleted are never listed as results of the
/// next replay.
fn killed_while_replacing() -> Result<(), Failed> {
    const EARLIER: u64 = 1000;
    let lambda = alarm("ram");
    let other = |out: &Path| {
        let mut replay = replay(lambda.path(), out);
        replay.args(["--set", "event_s=30"]);
        replay
    };
    let mut hits = 0;
    for _ in 0..20 {
        let out = TempFolder::new();
        replay(lambda.path(), out.path()).status()?;
        let clips = out.path().join("clips");
        let first = listed(out.path())?.remove(0);
        let stem = first.file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut list = std::fs::read_to_string(out.path().join("clips.jsonl"))?;
        for n in 1000..1000 + EARLIER {
            let file = format!("{stem}-{n}.mcap");
            std::fs::hard_link(out.path().join(&first.file), clips.join(&file))?;
            let clip =
                Clip { file: Path::new("clips").join(file), thumbnail: None, ..first.clone() };
            list.push_str(&(serde_json::to_string(&clip)? + "\n"));
        }
        std::fs::write(out.path().join("clips.jsonl"), list)?;
        let earlier = listed_names(out.path())?;
        let remaining = || earlier.iter().filter(|name| clips.join(name).exists()).count();
        let mut child = other(out.path()).spawn()?;
        while out.path().join(&first.file).exists() && child.try_wait()?.is_none() {}
        child.kill()?;
        child.wait()?;
        hits += u32::from((1..earlier.len()).contains(&remaining()));
        other(out.path()).status()?;
        let wrong: Vec<_> = listed_names(out.path())?.intersection(&earlier).cloned().collect();
        if !wrong.is_empty() || remaining() > 0 {
            let first = wrong.first();
            let (listed, left) = (wrong.len(), remaining());
            return Err(format!(
                "{listed} clips of an earlier replay are listed, {left} remain: {first:?}"
            )
            .into());
        }
        if hits >= 3 {
            return Ok(());
        }
    }
    if hits > 0 { Ok(()) } else { Err("no kill hit a replay that replaces clips".into()) }
}

struct CrashRemains {
    listed: usize,
    recovered: usize,
}

/// Checks the remains of a process: listed clips at once, the others after the next start.
fn inspect(out: &Path) -> Result<CrashRemains, Failed> {
    let listed = listed(out)?;
    for clip in &listed {
        is_complete(&out.join(&clip.file))?;
    }
    if !out.join("clips").exists() {
        return Ok(CrashRemains { listed: 0, recovered: 0 });
    }
    let (_folder, recovered) = Clips::open(out)?;
    let names = listed_names(out)?;
    for entry in std::fs::read_dir(out.join("clips"))? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match path.extension().and_then(OsStr::to_str) {
            Some("mcap") => {
                is_complete(&path)?;
                if !names.contains(&name) {
                    return Err(format!("`{name}` is not listed").into());
                }
            }
            Some("jpg") => {
                if !std::fs::read(&path)?.ends_with(&[0xff, 0xd9]) {
                    return Err(format!("`{name}` is truncated").into());
                }
            }
            _ if name.starts_with('.') => {}
            _ => return Err(format!("`{name}` is an orphan").into()),
        }
    }
    Ok(CrashRemains { listed: listed.len(), recovered: recovered.len() })
}

/// The complete lines of `clips.jsonl`.
fn listed(out: &Path) -> Result<Vec<Clip>, Failed> {
    let text = std::fs::read_to_string(out.join("clips.jsonl")).unwrap_or_default();
    let complete = text.rfind('\n').map_or("", |end| &text[..end]);
    complete.lines().map(|line| Ok(serde_json::from_str(line)?)).collect()
}

fn listed_names(out: &Path) -> Result<BTreeSet<String>, Failed> {
    let names = listed(out)?
        .into_iter()
        .map(|clip| clip.file.file_name().unwrap_or_default().to_string_lossy().into_owned());
    Ok(names.collect())
}

/// Reads a clip to its end and checks all checksums.
fn is_complete(path: &PathBuf) -> Result<(), Failed> {
    let failed =
        |error: &dyn std::error::Error| Failed::from(format!("{}: {error}", path.display()));
    let mut clip = Replay::open(std::slice::from_ref(path)).map_err(|error| failed(&error))?;
    for topic in clip.topics() {
        let spec = TopicSpec {
            topic: topic.topic,
            type_name: topic.type_name,
            queue: 1,
            max_bytes: usize::MAX,
            qos: Default::default(),
        };
        clip.subscribe(&spec, Arc::new(DiscardSink)).map_err(|error| failed(&error))?;
    }
    while clip.step().map_err(|error| failed(&error))?.is_some() {}
    Ok(())
}

/// Script for a mount namespace: the disk is a small tmpfs, whose files are copied out at the end.
const ON_A_SMALL_DISK: &str = r#"
set -e
mount -t tmpfs -o size="$1" tmpfs "$2"
shift
disk=$1 copy=$2
shift 2
code=0
"$@" > /dev/null 2> "$copy/stderr" || code=$?
cp -a "$disk/." "$copy/left"
echo "$code"
"#;

fn in_namespace(script: &str, args: &[&OsStr]) -> Command {
    let mut unshare = Command::new("unshare");
    unshare.args(["--user", "--map-root-user", "--mount", "sh", "-c", script, "sh"]).args(args);
    unshare
}

fn can_mount() -> Result<(), String> {
    let folder = TempFolder::new();
    let mount =
        in_namespace("mount -t tmpfs -o size=16k tmpfs \"$1\"", &[folder.path().as_ref()]).output();
    let is_mounted = mount.is_ok_and(|output| output.status.success());
    is_mounted.then_some(()).ok_or("cannot mount a file system".to_owned())
}

fn full_disk() -> Result<(), Failed> {
    for store in ["ram", "disk"] {
        let lambda = alarm(store);
        // The first run compiles the lambda.
        replay(lambda.path(), TempFolder::new().path()).status()?;
        let (mut full, mut fits) = (0, 0);
        let mut kib = 4;
        while kib < 16_384 {
            let (disk, copy) = (TempFolder::new(), TempFolder::new());
            std::fs::create_dir(copy.path().join("left"))?;
            let size = format!("{kib}k");
            let places = [OsStr::new(&size), disk.path().as_os_str(), copy.path().as_os_str()];
            let mut replay = in_namespace(ON_A_SMALL_DISK, &places);
            replay.arg(program("gleaner-runtime")).arg("replay").arg(lambda.path());
            replay.arg(sample_drive()).args(["--set", EVENTS, "--out"]).arg(disk.path());
            let output = replay.env("XDG_CACHE_HOME", root().join("target/test-cache")).output()?;
            let stderr = std::fs::read_to_string(copy.path().join("stderr"))?;
            let with_context =
                |why: &str| Failed::from(format!("{store}, {kib} KiB: {why}\n{stderr}"));
            match String::from_utf8_lossy(&output.stdout).trim() {
                "0" => fits += 1,
                "1" => {
                    full += 1;
                    let lacks = |texts: [&str; 2]| texts.iter().any(|text| !stderr.contains(text));
                    let path = disk.path().to_string_lossy();
                    if stderr.contains("panicked") || lacks(["error: cannot", "No space left"]) {
                        return Err(with_context("the error does not name the cause"));
                    }
                    if lacks(["make room", &*path]) {
                        let why = "the error names neither the file nor the way out";
                        return Err(with_context(why));
                    }
                }
                other => {
                    return Err(with_context(&format!(
                        "ended with {other}: {}",
                        String::from_utf8_lossy(&output.stderr)
                    )));
                }
            }
            inspect(&copy.path().join("left"))
                .map_err(|why| with_context(why.message().unwrap_or_default()))?;
            // Smaller steps where most of the small writes happen.
            kib += if kib < 256 { 12 } else { kib / 8 };
        }
        let counts = format!("{store}: {full} disks were too small, {fits} large enough");
        println!("{counts}");
        if full < 20 || fits == 0 {
            return Err(counts.into());
        }
    }
    Ok(())
}
