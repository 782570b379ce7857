//! Whatever ends the recorder, a clip that is listed is whole, and nothing under a final name is
//! broken.
//!
//! `GLEANER_KILLS` says how often the process is killed; 25 times if it does not.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_drives::Replay;
use gleaner_lambda::Clip;
use gleaner_recorder::Folder as Clips;
use gleaner_tests::{Copy, Folder, program, root, runtime, sample_drive, times};
use gleaner_transport::{SampleMeta, Sink, TopicSpec, Transport, Verdict};
use libtest_mimic::{Failed, Trial};

/// Events all along the drive, so that clips begin and end at many moments.
const EVENTS: &str = "event_s=2,8,14,20,26,32,38";

pub fn trials() -> Vec<Trial> {
    let mut trials = vec![
        Trial::test("a_recorder_killed_at_any_moment_leaves_nothing_broken", || killed("ram")),
        Trial::test(
            "a_recorder_with_its_preroll_on_disk_killed_at_any_moment_leaves_nothing_broken",
            || killed("disk"),
        ),
    ];
    let name = "a_replay_killed_while_it_replaces_clips_leaves_none_of_them_to_the_next";
    trials.push(Trial::test(name, killed_while_replacing));
    let name = "a_full_disk_is_an_error_with_a_name_and_leaves_nothing_broken";
    trials.push(if can_mount() {
        Trial::test(name, full_disk)
    } else {
        Trial::test(format!("{name} [no file system can be mounted here]"), || Ok(()))
            .with_ignored_flag(true)
    });
    trials
}

/// `alarm`, with short windows, so that there are several clips.
fn alarm(store: &str) -> Copy {
    Copy::of("tests/lambdas/alarm/rust", |manifest| {
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
    let out = Folder::new();
    // The first compiles the lambda.
    replay(lambda.path(), out.path()).status()?;
    // One that others held up would put most kills behind the end.
    let mut duration = Duration::MAX;
    for _ in 0..3 {
        let started = Instant::now();
        replay(lambda.path(), out.path()).status()?;
        duration = duration.min(started.elapsed());
    }
    let kills = times("GLEANER_KILLS", 25);
    let mut seen = [0_u32; 3];
    let mut out = Folder::new();
    let mut random = 0x9e37_79b9_7f4a_7c15_u64;
    let mut killed = 0;
    // Kills that met nothing show nothing: it goes on until some have.
    while killed < kills || killed < 10 * kills && (seen[0] == 0 || seen[1] == 0) {
        let kill = killed;
        killed += 1;
        // xorshift64: the moments differ, and a run can be repeated as far as a machine repeats
        // itself.
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        // Every third one meets what the two before it left, so that recovery is killed, too.
        if kill % 3 == 0 {
            out = Folder::new();
        }
        let mut child = replay(lambda.path(), out.path()).spawn()?;
        thread::sleep(Duration::from_nanos(
            (duration.as_nanos() as u64).saturating_mul(random % 1000) / 1000,
        ));
        child.kill()?;
        child.wait()?;
        let here = |why: Failed| {
            Failed::from(format!("kill {kill}: {}", why.message().unwrap_or_default()))
        };
        for clip in listed(out.path())? {
            whole(&out.path().join(&clip.file)).map_err(here)?;
        }
        if kill % 3 < 2 {
            continue;
        }
        let found = inspect(out.path()).map_err(here)?;
        seen[0] += u32::from(found.listed > 0);
        seen[1] += u32::from(found.recovered > 0);
        seen[2] += found.recovered as u32;
    }
    println!(
        "{store}: {killed} kills, three in each folder: {} folders had listed clips, {} something to recover, {} clips",
        seen[0], seen[1], seen[2]
    );
    if seen[0] == 0 || seen[1] == 0 {
        return Err(format!("no kill met a recorder at work: {seen:?}").into());
    }
    Ok(())
}

/// Clips of an earlier replay that a kill leaves half deleted are never listed as results of the
/// next one.
fn killed_while_replacing() -> Result<(), Failed> {
    const EARLIER: u64 = 1000;
    let lambda = alarm("ram");
    let other = |out: &Path| {
        let mut replay = replay(lambda.path(), out);
        replay.args(["--set", "event_s=30"]);
        replay
    };
    let mut met = 0;
    for _ in 0..20 {
        let out = Folder::new();
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
        let are_left = || earlier.iter().filter(|name| clips.join(name).exists()).count();
        let mut child = other(out.path()).spawn()?;
        while out.path().join(&first.file).exists() && child.try_wait()?.is_none() {}
        child.kill()?;
        child.wait()?;
        met += u32::from((1..earlier.len()).contains(&are_left()));
        other(out.path()).status()?;
        let strangers: Vec<_> = listed_names(out.path())?.intersection(&earlier).cloned().collect();
        if !strangers.is_empty() || are_left() > 0 {
            let first = strangers.first();
            let (listed, left) = (strangers.len(), are_left());
            return Err(format!(
                "{listed} clips of an earlier replay are listed, {left} are left: {first:?}"
            )
            .into());
        }
        if met >= 3 {
            return Ok(());
        }
    }
    if met > 0 { Ok(()) } else { Err("no kill met a replay that replaces clips".into()) }
}

struct Found {
    listed: usize,
    recovered: usize,
}

/// Looks at what a process left: listed clips at once, the others after the next start.
fn inspect(out: &Path) -> Result<Found, Failed> {
    let listed = listed(out)?;
    for clip in &listed {
        whole(&out.join(&clip.file))?;
    }
    if !out.join("clips").exists() {
        return Ok(Found { listed: 0, recovered: 0 });
    }
    let (_folder, recovered) = Clips::open(out)?;
    let names = listed_names(out)?;
    for entry in std::fs::read_dir(out.join("clips"))? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match path.extension().and_then(OsStr::to_str) {
            Some("mcap") => {
                whole(&path)?;
                if !names.contains(&name) {
                    return Err(format!("`{name}` is not listed").into());
                }
            }
            Some("jpg") => {
                if !std::fs::read(&path)?.ends_with(&[0xff, 0xd9]) {
                    return Err(format!("`{name}` is cut off").into());
                }
            }
            _ if name.starts_with('.') => {}
            _ => return Err(format!("`{name}` was left behind").into()),
        }
    }
    Ok(Found { listed: listed.len(), recovered: recovered.len() })
}

/// The whole lines of `clips.jsonl`.
fn listed(out: &Path) -> Result<Vec<Clip>, Failed> {
    let text = std::fs::read_to_string(out.join("clips.jsonl")).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole.lines().map(|line| Ok(serde_json::from_str(line)?)).collect()
}

fn listed_names(out: &Path) -> Result<BTreeSet<String>, Failed> {
    let names = listed(out)?
        .into_iter()
        .map(|clip| clip.file.file_name().unwrap_or_default().to_string_lossy().into_owned());
    Ok(names.collect())
}

/// Reads a clip to its end, all checksums included.
fn whole(path: &PathBuf) -> Result<(), Failed> {
    struct Nowhere;
    impl Sink for Nowhere {
        fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Verdict {
            Verdict::Taken
        }
    }
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
        clip.subscribe(&spec, Arc::new(Nowhere)).map_err(|error| failed(&error))?;
    }
    while clip.step().map_err(|error| failed(&error))?.is_some() {}
    Ok(())
}

/// In a mount namespace of its own: the disk is a small tmpfs, what is left on it is copied out.
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

fn can_mount() -> bool {
    let folder = Folder::new();
    let mount =
        in_namespace("mount -t tmpfs -o size=16k tmpfs \"$1\"", &[folder.path().as_ref()]).output();
    mount.is_ok_and(|output| output.status.success())
}

fn full_disk() -> Result<(), Failed> {
    for store in ["ram", "disk"] {
        let lambda = alarm(store);
        // The first compiles the lambda.
        replay(lambda.path(), Folder::new().path()).status()?;
        let (mut full, mut fits) = (0, 0);
        let mut kib = 4;
        while kib < 16_384 {
            let (disk, copy) = (Folder::new(), Folder::new());
            std::fs::create_dir(copy.path().join("left"))?;
            let size = format!("{kib}k");
            let (program, drive) = (program("gleaner-runtime"), sample_drive());
            let mut args: Vec<&OsStr> =
                vec![size.as_ref(), disk.path().as_ref(), copy.path().as_ref()];
            args.extend([
                program.as_os_str(),
                "replay".as_ref(),
                lambda.path().as_ref(),
                drive.as_ref(),
            ]);
            args.extend([
                "--set".as_ref(),
                EVENTS.as_ref(),
                "--out".as_ref(),
                disk.path().as_os_str(),
            ]);
            let mut replay = in_namespace(ON_A_SMALL_DISK, &args);
            let output = replay.env("XDG_CACHE_HOME", root().join("target/test-cache")).output()?;
            let said = std::fs::read_to_string(copy.path().join("stderr"))?;
            let here = |why: &str| Failed::from(format!("{store}, {kib} KiB: {why}\n{said}"));
            match String::from_utf8_lossy(&output.stdout).trim() {
                "0" => fits += 1,
                "1" => {
                    full += 1;
                    if said.contains("panicked")
                        || !said.contains("error: cannot")
                        || !said.contains("No space left")
                    {
                        return Err(here("the error does not say what happened"));
                    }
                    if !said.contains("make room")
                        || !said.contains(&*disk.path().to_string_lossy())
                    {
                        return Err(here("the error names neither the file nor the way out"));
                    }
                }
                other => {
                    return Err(here(&format!(
                        "ended with {other}: {}",
                        String::from_utf8_lossy(&output.stderr)
                    )));
                }
            }
            inspect(&copy.path().join("left"))
                .map_err(|why| here(why.message().unwrap_or_default()))?;
            // Closer together where more of the small writes happen.
            kib += if kib < 256 { 12 } else { kib / 8 };
        }
        println!("{store}: {full} disks were too small, {fits} large enough");
        if full < 20 || fits == 0 {
            return Err(format!("{store}: {full} disks were too small, {fits} large enough").into());
        }
    }
    Ok(())
}
