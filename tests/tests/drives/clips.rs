//! Clips hold exactly the messages of their windows, and third-party readers can read them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use gleaner_lambda::Clip;
use gleaner_tests::drive::corrupted;
use gleaner_tests::readers::{compare_clips, foreign_python};
use gleaner_tests::{
    LambdaCopy, ReplayRun, TempFolder, replay_to, root, sample_drive, shared_file,
};
use libtest_mimic::{Failed, Trial};

pub fn trials() -> Vec<Trial> {
    let mut trials = vec![
        Trial::test("two_triggers_4_s_apart_give_one_clip", || windows("10,14", &[(5.0, 19.0, 2)])),
        Trial::test("two_triggers_8_s_apart_overlap_too", || windows("10,18", &[(5.0, 23.0, 2)])),
        Trial::test("two_triggers_11_s_apart_give_two_clips", || {
            windows("10,21", &[(5.0, 15.0, 1), (16.0, 26.0, 1)])
        }),
        Trial::test("a_start_lasts_until_its_stop", starts_and_stops),
        Trial::test("a_window_beyond_the_end_of_the_drive_is_marked_incomplete", at_the_end),
        Trial::test("a_preroll_from_before_the_drive_is_marked_incomplete", at_the_begin),
        Trial::test("a_long_recording_continues_in_another_clip_without_a_gap", rolls_over),
        Trial::test(
            "messages_that_do_not_fit_into_the_preroll_are_counted_and_reported",
            evicted_early,
        ),
        Trial::test("a_preroll_on_disk_gives_the_same_clips", on_disk),
        Trial::test(
            "a_topic_that_the_drive_does_not_have_is_listed_without_messages",
            missing_topic,
        ),
        Trial::test("a_second_replay_replaces_the_clips_of_the_first", replaced),
        Trial::test("a_clip_that_the_user_copied_there_is_kept", copied),
        Trial::test("without_record_there_are_no_clips", no_record),
        Trial::test("two_topics_remapped_to_one_are_recorded_once", one_of_two),
        Trial::test("a_clip_ends_where_its_drive_is_damaged", damaged),
        Trial::test("a_lambda_that_does_not_start_keeps_all_earlier_results", not_started),
        Trial::test("a_concurrent_replay_is_refused_also_without_clips", busy_without_clips),
        Trial::test("a_concurrent_replay_does_not_change_the_results_of_the_first", busy),
    ];
    let mut read = |name: &str, drive: Result<PathBuf, String>, args: &'static [&'static str]| {
        let needed = drive.and_then(|drive| foreign_python().map(|_| drive));
        trials.push(needing(name, needed, move |drive| reads(&drive, args)));
    };
    read(
        "mcap_rosbags_and_mcap_ros2_read_the_clips_of_the_sample_drive",
        Ok(sample_drive()),
        &["--set", "event_s=4,8,20,38"],
    );
    read(
        "mcap_rosbags_and_mcap_ros2_read_the_clips_of_rec_brake_dark",
        shared_file("rec_brake_dark.mcap"),
        &["--set", "event_s=5,9,35"],
    );
    trials
}

/// A test with something that is not available everywhere; ignored without it, with the reason in
/// its name.
pub fn needing<T: Send + 'static>(
    name: &str,
    needed: Result<T, String>,
    test: impl FnOnce(T) -> Result<(), Failed> + Send + 'static,
) -> Trial {
    match needed {
        Ok(needed) => Trial::test(name, move || test(needed)),
        Err(why) => Trial::test(format!("{name} [{why}]"), || Ok(())).with_ignored_flag(true),
    }
}

fn alarm() -> PathBuf {
    root().join("tests/lambdas/alarm/rust")
}

/// `alarm`, with another text in its manifest.
fn changed_alarm(from: &str, to: &str) -> LambdaCopy {
    LambdaCopy::of("tests/lambdas/alarm/rust", |manifest| manifest.replace(from, to))
}

/// Replays a lambda; third-party readers compare its clips with the drive.
fn record(lambda: &Path, drive: &Path, args: &[&str]) -> Result<(TempFolder, ReplayRun), Failed> {
    let out = TempFolder::new();
    let run = replay_to(out.path(), lambda, &[drive.to_owned()], args);
    if run.exit != 0 {
        return Err(format!("exit {}: {}", run.exit, run.stderr).into());
    }
    if !run.clips.is_empty() {
        compare_clips(out.path(), &[drive.to_owned()]);
    }
    Ok((out, run))
}

fn seconds(run: &ReplayRun, at_ns: i64) -> f64 {
    let start_ns = run.summary.as_ref().map_or(0, |summary| summary.start_ns);
    (at_ns - start_ns) as f64 / 1e9
}

pub fn same<T: PartialEq + std::fmt::Debug>(found: &T, expected: &T) -> Result<(), Failed> {
    if found == expected {
        Ok(())
    } else {
        Err(format!("found {found:?}, expected {expected:?}").into())
    }
}

/// Events at `event_s` give clips with these begins, ends and numbers of triggers.
fn windows(event_s: &str, expected: &[(f64, f64, u64)]) -> Result<(), Failed> {
    let (out, run) = record(&alarm(), &sample_drive(), &["--set", &format!("event_s={event_s}")])?;
    let tenths = |clip: &Clip| {
        let [from, to] =
            [clip.from_ns, clip.to_ns].map(|at_ns| (seconds(&run, at_ns) * 10.0).round() / 10.0);
        (from, to, clip.triggers)
    };
    same(&run.clips.iter().map(tenths).collect(), &expected.to_vec())?;
    run.clips.iter().try_for_each(|clip| is_complete(out.path(), clip, clip.from_ns, clip.to_ns))
}

/// Checks that the clip and its thumbnail exist, and that it holds exactly the messages of the
/// drive in its window.
fn is_complete(out: &Path, clip: &Clip, from_ns: i64, to_ns: i64) -> Result<(), Failed> {
    let thumbnail = clip.thumbnail.as_ref().ok_or("no thumbnail")?;
    same(&std::fs::read(out.join(thumbnail))?.starts_with(&[0xff, 0xd8]), &true)?;
    same(&std::fs::metadata(out.join(&clip.file))?.len(), &clip.bytes)?;
    let (drive, found) = (messages(&sample_drive())?, messages(&out.join(&clip.file))?);
    let wanted = drive
        .into_iter()
        .filter(|message| (from_ns..=to_ns).contains(&message.1))
        .collect::<Vec<_>>();
    same(&found.len(), &wanted.len())?;
    if found != wanted {
        return Err("the messages differ".into());
    }
    for topic in &clip.topics {
        let n = found.iter().filter(|message| message.0 == topic.topic).count() as u64;
        same(
            &(topic.messages, topic.received, topic.overwritten, topic.too_big),
            &(n, Some(n), Some(0), Some(0)),
        )?;
        same(&topic.lost, &None)?;
    }
    Ok(())
}

/// Topic, log time, publish time and bytes of a message.
type ClipContent = (String, i64, u64, Vec<u8>);

/// All messages, sorted.
fn messages(path: &Path) -> Result<Vec<ClipContent>, Failed> {
    let bytes = std::fs::read(path)?;
    let mut all = Vec::new();
    for message in mcap::MessageStream::new(&bytes)? {
        let message = message?;
        all.push((
            message.channel.topic.clone(),
            message.log_time as i64,
            message.publish_time,
            message.data.to_vec(),
        ));
    }
    all.sort();
    Ok(all)
}

fn starts_and_stops() -> Result<(), Failed> {
    let (out, run) =
        record(&alarm(), &sample_drive(), &["--set", "start_s=12", "--set", "stop_s=20"])?;
    same(&run.clips.len(), &1)?;
    let clip = &run.clips[0];
    same(&[clip.from_ns, clip.to_ns].map(|at_ns| seconds(&run, at_ns).round()), &[7.0, 25.0])?;
    same(&clip.incomplete, &Vec::new())?;
    is_complete(out.path(), clip, clip.from_ns, clip.to_ns)
}

fn at_the_end() -> Result<(), Failed> {
    let (out, run) =
        record(&alarm(), &sample_drive(), &["--set", "event_s=38", "--set", "start_s=20"])?;
    same(&run.clips.len(), &1)?;
    let clip = &run.clips[0];
    same(&clip.incomplete.iter().any(|why| why.contains("the drive ended")), &true)?;
    is_complete(out.path(), clip, clip.from_ns, i64::MAX)
}

fn at_the_begin() -> Result<(), Failed> {
    let (out, run) = record(&alarm(), &sample_drive(), &["--set", "event_s=2"])?;
    same(&run.clips.len(), &1)?;
    let clip = &run.clips[0];
    same(&clip.incomplete.iter().any(|why| why.contains("preroll")), &true)?;
    is_complete(out.path(), clip, i64::MIN, clip.to_ns)
}

fn rolls_over() -> Result<(), Failed> {
    let lambda = changed_alarm("[record]", "[record]\nmax_length = \"7s\"");
    let (out, run) =
        record(lambda.path(), &sample_drive(), &["--set", "start_s=10", "--set", "stop_s=30"])?;
    same(&(run.clips.len() >= 4), &true)?;
    let (first, last) = (&run.clips[0], &run.clips[run.clips.len() - 1]);
    let mut found = Vec::new();
    for clip in &run.clips {
        same(&(seconds(&run, clip.to_ns) - seconds(&run, clip.from_ns) <= 7.01), &true)?;
        found.extend(messages(&out.path().join(&clip.file))?);
    }
    found.sort();
    let drive = messages(&sample_drive())?.into_iter();
    let wanted = drive
        .filter(|message| (first.from_ns..=last.to_ns).contains(&message.1))
        .collect::<Vec<_>>();
    same(&(found == wanted, found.len()), &(true, wanted.len()))?;
    same(&first.incomplete.iter().any(|why| why.contains("next clip")), &true)
}

fn evicted_early() -> Result<(), Failed> {
    let lambda = LambdaCopy::of("tests/lambdas/alarm/rust", |manifest| {
        manifest
            .replace("[record]", "[record]\npreroll_size = \"1 MiB\"")
            .replace("preroll = \"5s\"", "preroll = \"20s\"")
    });
    let (out, run) = record(lambda.path(), &sample_drive(), &["--set", "event_s=30"])?;
    same(&run.clips.len(), &1)?;
    let clip = &run.clips[0];
    let drive = messages(&sample_drive())?;
    for topic in &clip.topics {
        let wanted = drive.iter().filter(|(name, at_ns, ..)| {
            *name == topic.topic && (clip.from_ns..=clip.to_ns).contains(at_ns)
        });
        let wanted = wanted.count() as u64;
        same(&(topic.messages < wanted, topic.received), &(true, Some(wanted)))?;
        same(&topic.overwritten, &Some(wanted - topic.messages))?;
    }
    same(
        &messages(&out.path().join(&clip.file))?.len(),
        &(clip.topics.iter().map(|topic| topic.messages).sum::<u64>() as usize),
    )?;
    same(&clip.incomplete.iter().any(|why| why.contains("preroll_size")), &true)
}

fn on_disk() -> Result<(), Failed> {
    let lambda = changed_alarm("[record]", "[record]\nstore = \"disk\"");
    let args = ["--set", "event_s=10,14,30"];
    let (ram_out, ram) = record(&alarm(), &sample_drive(), &args)?;
    let (disk_out, disk) = record(lambda.path(), &sample_drive(), &args)?;
    same(&(ram.clips.len(), disk.clips.len()), &(2, 2))?;
    for (ram, disk) in ram.clips.iter().zip(&disk.clips) {
        same(&(&ram.topics, ram.from_ns, ram.to_ns), &(&disk.topics, disk.from_ns, disk.to_ns))?;
        let found = messages(&disk_out.path().join(&disk.file))?;
        same(&(found == messages(&ram_out.path().join(&ram.file))?), &true)?;
    }
    Ok(())
}

fn missing_topic() -> Result<(), Failed> {
    let lambda = changed_alarm("/vehicle/speed", "/lidar/points");
    let (_out, run) = record(lambda.path(), &sample_drive(), &["--set", "event_s=10"])?;
    let lidar = run.clips[0]
        .topics
        .iter()
        .find(|topic| topic.topic == "/lidar/points")
        .ok_or("the topic is not listed")?;
    same(&(lidar.messages, lidar.received, &lidar.type_name), &(0, Some(0), &None))?;
    same(&run.stderr.contains("/lidar/points"), &true)
}

fn replaced() -> Result<(), Failed> {
    let (out, first) = record(&alarm(), &sample_drive(), &["--set", "event_s=10"])?;
    let second = replay_to(out.path(), &alarm(), &[sample_drive()], &["--set", "event_s=25"]);
    same(&(first.clips.len(), second.clips.len()), &(1, 1))?;
    same(&out.path().join(&first.clips[0].file).exists(), &false)?;
    same(&out.path().join(&second.clips[0].file).exists(), &true)
}

fn copied() -> Result<(), Failed> {
    let (out, first) = record(&alarm(), &sample_drive(), &["--set", "event_s=10"])?;
    let copy = out.path().join("clips/favourite.mcap");
    std::fs::copy(out.path().join(&first.clips[0].file), &copy)?;
    for event in ["event_s=25", "event_s=26"] {
        let again = replay_to(out.path(), &alarm(), &[sample_drive()], &["--set", event]);
        same(&(again.exit, again.clips.len(), copy.exists()), &(0, 1, true))?;
        same(&again.summary.map(|summary| summary.clips_replaced), &Some(1))?;
    }
    Ok(())
}

fn no_record() -> Result<(), Failed> {
    let (out, run) = record(&alarm(), &sample_drive(), &["--set", "event_s=10", "--no-record"])?;
    same(&(run.clips.len(), out.path().join("clips").exists()), &(0, false))?;
    // Clips of an earlier replay do not remain beside results without clips.
    let (out, _run) = record(&alarm(), &sample_drive(), &["--set", "event_s=10"])?;
    let again = replay_to(out.path(), &alarm(), &[sample_drive()], &["--no-record"]);
    same(&(again.clips.len(), again.summary.map(|summary| summary.clips_replaced)), &(0, Some(1)))
}

fn one_of_two() -> Result<(), Failed> {
    let lambda = changed_alarm("topics = [", "topics = [\"/imu/other\", ");
    let args = ["--set", "event_s=10", "--remap", "/imu/other:=/imu/data"];
    let (out, run) = record(lambda.path(), &sample_drive(), &args)?;
    is_complete(out.path(), &run.clips[0], run.clips[0].from_ns, run.clips[0].to_ns)
}

fn damaged() -> Result<(), Failed> {
    let (out, folder) = (TempFolder::new(), TempFolder::new());
    let run = replay_to(
        out.path(),
        &alarm(),
        &[corrupted(&folder)],
        &["--set", "event_s=10", "--set", "start_s=12"],
    );
    same(&(run.exit, run.clips.len()), &(7, 1))?;
    let clip = &run.clips[0];
    same(&clip.incomplete.iter().any(|why| why.contains("the drive ended")), &true)?;
    same(
        &(Some(clip.to_ns) >= clip.last_ns, messages(&out.path().join(&clip.file))?.len() > 1000),
        &(true, true),
    )
}

fn busy() -> Result<(), Failed> {
    let (out, _run) = record(&alarm(), &sample_drive(), &["--set", "event_s=10"])?;
    let (first, recovered) = gleaner_recorder::RecordingFolder::open(out.path())?;
    same(&recovered.len(), &0)?;
    let before = std::fs::read_to_string(out.path().join("decisions.jsonl"))?;
    let second = replay_to(out.path(), &alarm(), &[sample_drive()], &["--set", "event_s=20"]);
    same(&(second.exit, second.stderr.contains(&*out.path().to_string_lossy())), &(1, true))?;
    same(&std::fs::read_to_string(out.path().join("decisions.jsonl"))?, &before)?;
    drop(first);
    Ok(())
}

fn busy_without_clips() -> Result<(), Failed> {
    let args = ["--set", "event_s=10", "--no-record"];
    let (out, _run) = record(&alarm(), &sample_drive(), &args)?;
    let lock = std::fs::File::open(out.path().join(".lock"))?;
    lock.try_lock()?;
    let before = files(out.path())?;
    let second = replay_to(out.path(), &alarm(), &[sample_drive()], &args);
    let expected = format!("another replay writes into `{}`", out.path().display());
    same(
        &(second.exit, second.stderr.contains(&expected), second.stderr.contains("--out DIR")),
        &(1, true, true),
    )?;
    same(&(files(out.path())? == before), &true)?;
    lock.unlock()?;
    same(&replay_to(out.path(), &alarm(), &[sample_drive()], &args).exit, &0)
}

fn not_started() -> Result<(), Failed> {
    for with in [&[][..], &["--no-record"]] {
        let out = TempFolder::new();
        let journal = out.path().join("wakes.journal");
        let args = [&["--journal", journal.to_str().ok_or("not UTF-8")?], with].concat();
        let replay = |event: &str| {
            replay_to(
                out.path(),
                &alarm(),
                &[sample_drive()],
                &[&args[..], &["--set", event]].concat(),
            )
        };
        same(&(replay("event_s=10").exit, replay("event_s=10").exit), &(0, 0))?;
        let before = files(out.path())?;
        same(&(before.len() > 5), &true)?;
        let failed = replay("event_s=ten");
        same(&(failed.exit, failed.stderr.contains("cannot start lambda `alarm`")), &(6, true))?;
        same(&(files(out.path())? == before), &true)?;
    }
    Ok(())
}

/// Every file in and below `folder`, with its content.
fn files(folder: &Path) -> Result<BTreeMap<PathBuf, Vec<u8>>, Failed> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            found.extend(files(&path)?);
        } else {
            let content = std::fs::read(&path)?;
            found.insert(path, content);
        }
    }
    Ok(found)
}

/// Third-party readers find the messages of the drive in each clip: see [`record`].
fn reads(drive: &Path, args: &[&str]) -> Result<(), Failed> {
    let (_out, run) = record(&alarm(), drive, args)?;
    same(&(run.clips.len() >= 2), &true)
}
