//! Tests that kill the recording process at any time: reported clips are there, and open ones are
//! recovered.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use super::running::*;
use crate::RecordingFolder;
use crate::recorder::tests::support::*;
use gleaner_lambda::Clip;
use gleaner_lambda::TriggerKind::Event;
use gleaner_messages::transport::Clock;
use gleaner_protocol::link::{RecorderLink, RecorderReport};

/// Number of kills without `GLEANER_KILLS`, each after a second and a half on average; twenty times
/// as many with `GLEANER_LONG=1`.
const KILLS: u64 = 10;

/// Not a test: the process that the next test kills.
#[test]
#[ignore = "started by reported_clips_are_complete_and_open_ones_are_recovered_after_any_kill"]
fn child() {
    let Some(out) = std::env::var_os("GLEANER_TEST_OUT") else { return };
    let scratch = std::mem::ManuallyDrop::new(TestDir(out.into()));
    let (network, clock) = (FakeNetwork::default(), Clock::from_time_of_day());
    network.add("/a");
    // Reports in a file are written, whenever the kill comes.
    let reports = File::create(scratch.0.join("reports.jsonl")).unwrap();
    let options = options(&scratch.0, clock);
    let (mut starter, _) = FakeStarter::start(&network, options, reports, Arc::default());
    let (folder, header) = lambda(&scratch, "first", (300, 1500));
    let mut link = RecorderLink::new(starter.add(&add(&folder)).unwrap());
    link.hello(&header, TIMEOUT).unwrap();
    let (short, short_header) = lambda(&scratch, "short", (30, 30));
    let mut short = RecorderLink::new(starter.add(&add(&short)).unwrap());
    short.hello(&short_header, TIMEOUT).unwrap();
    let _sensor = Sensor::start(&network, clock);
    // Small clips one after the other, and one of several chunks every three seconds.
    for round in 0_u64.. {
        let kinds = if round % 20 == 5 { &[Event][..] } else { &[] };
        link.wake(&entry(clock.now(), kinds), monotonic(clock)).unwrap();
        short.wake(&entry(clock.now(), &[Event]), monotonic(clock)).unwrap();
        thread::sleep(Duration::from_millis(150));
        link.poll().unwrap();
        short.poll().unwrap();
    }
}

fn reports(out: &Path) -> Vec<RecorderReport> {
    let text = fs::read_to_string(out.join("reports.jsonl")).unwrap_or_default();
    let whole = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    whole.map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Numbers of the messages in the complete chunks of an unfinished file, read by the crate `mcap`.
fn in_whole_chunks(part: &Path) -> Vec<u32> {
    let bytes = fs::read(part).unwrap();
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let Ok(messages) = mcap::MessageStream::new_with_options(&bytes, options) else {
        return Vec::new();
    };
    messages.map_while(Result::ok).map(|message| message.sequence).collect()
}

fn numbers(scratch: &TestDir, clip: &Clip) -> Vec<u32> {
    scratch.messages(clip).into_iter().map(|(_, _, seq, _)| seq).collect()
}

#[test]
fn reported_clips_are_complete_and_open_ones_are_recovered_after_any_kill() {
    let usual = if std::env::var("GLEANER_LONG").is_ok_and(|value| value == "1") {
        20 * KILLS
    } else {
        KILLS
    };
    let kills = std::env::var("GLEANER_KILLS").map_or(usual, |kills| kills.parse().unwrap());
    let mut random = SeededRandom(5);
    let (mut reported, mut saved, mut saved_messages) = (0, 0, 0);
    for kill in 0..kills {
        let scratch = TestDir::new();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "program::tests::kills::child", "--ignored"])
            .env("GLEANER_TEST_OUT", &scratch.0)
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let deadline = Instant::now() + TIMEOUT;
        while reports(&scratch.0).is_empty() {
            assert!(
                Instant::now() < deadline && child.try_wait().unwrap().is_none(),
                "kill {kill}: it does not start"
            );
            thread::sleep(Duration::from_millis(1));
        }
        thread::sleep(Duration::from_millis(random.below(3000) as u64));
        child.kill().unwrap();
        child.wait().unwrap();
        let parts: Vec<Vec<u32>> = fs::read_dir(scratch.0.join("clips"))
            .into_iter()
            .flatten()
            .map(|file| file.unwrap().path())
            .filter(|path| path.extension().is_some_and(|end| end == "part"))
            .map(|path| in_whole_chunks(&path))
            .collect();
        let (_folder, recovered) = RecordingFolder::open(&scratch.0).unwrap();
        let listed = fs::read_to_string(scratch.0.join("clips.jsonl")).unwrap_or_default();
        let listed: Vec<Clip> =
            listed.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        for report in reports(&scratch.0) {
            let RecorderReport::Clip(clip) = report else { continue };
            assert!(listed.contains(&clip), "kill {kill}: {clip:?}");
            reported += 1;
        }
        for clip in &listed {
            let numbers = numbers(&scratch, clip);
            assert!(follow_each_other(&numbers), "kill {kill}: {numbers:?}");
            let messages: u64 = clip.topics.iter().map(|topic| topic.messages).sum();
            assert_eq!(numbers.len() as u64, messages);
            if clip.recovered.is_none() {
                let journals =
                    clip.lambdas.iter().map(|lambda| scratch.journal(clip, &lambda.name).1.len());
                assert!(journals.sum::<usize>() > 0, "kill {kill}");
            }
        }
        // All complete chunks on the disk are recovered.
        let mut wanted: Vec<_> = parts.into_iter().filter(|numbers| !numbers.is_empty()).collect();
        wanted.sort();
        let mut found: Vec<_> = recovered
            .iter()
            .map(|clip| numbers(&scratch, clip))
            .filter(|n| !n.is_empty())
            .collect();
        found.sort();
        assert_eq!(found, wanted, "kill {kill}");
        saved += recovered.len();
        saved_messages += found.iter().map(Vec::len).sum::<usize>();
        let files =
            fs::read_dir(scratch.0.join("clips")).unwrap().map(|file| file.unwrap().file_name());
        let whole = files.filter(|name| name.to_string_lossy().ends_with(".mcap")).count();
        assert_eq!(whole, listed.len(), "kill {kill}");
    }
    println!(
        "{kills} kills: {reported} clips reported, {saved} recovered with {saved_messages} messages"
    );
    assert!(reported as u64 > kills / 10 && saved as u64 > kills / 10, "{reported} {saved}");
}
