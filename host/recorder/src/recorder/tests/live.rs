//! Tests that a live recorder makes the same clips as a replay of the same drive.

use std::time::Duration;

use super::support::*;
use crate::{Recorder, RecordingFolder, Settings, Work};
use gleaner_lambda::TriggerKind::{self, Start, Stop};
use gleaner_lambda::manifest::Store;
use gleaner_messages::transport::{Guid, SampleMeta};

fn live(scratch: &TestDir, change: impl FnOnce(&mut Settings)) -> Recorder {
    let mut settings =
        Settings { clock: "monotonic".to_owned(), prefault: true, ..scratch.settings() };
    change(&mut settings);
    Recorder::live(RecordingFolder::open(&scratch.0).unwrap().0, settings).unwrap()
}

/// The contents of each clip of a random drive. Triggers come at once; `work` is called at random
/// intervals.
fn random_drive(seed: u64, is_live: bool) -> Vec<Vec<(String, i64, u32)>> {
    let (mut random, mut pace) = (SeededRandom(seed), SeededRandom(seed + 1000));
    let scratch = TestDir::new();
    let store = |settings: &mut Settings| {
        settings.store = if seed.is_multiple_of(2) { Store::Ram } else { Store::Disk }
    };
    let mut recorder = if is_live { live(&scratch, store) } else { scratch.recorder(store) };
    let topics = ["/a", "/b", "/camera"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let rolls = [(random.below(80), random.below(60)), (random.below(500), random.below(20))];
    let lambdas = [
        recorder.add_lambda(member("l0", (rolls[0].0, rolls[0].1, 0), &[topics[0], topics[2]])),
        recorder.add_lambda(member(
            "l1",
            (rolls[1].0, rolls[1].1, random.below(40)),
            &[topics[1], topics[0]],
        )),
    ];
    for ms in 1000..3000 {
        let at = ms - random.below(3) * random.below(5);
        recorder
            .sample(topics[0], &meta(T0 + at * MS, ms as u64), &vec![7; random.below(300) as usize])
            .unwrap();
        if ms % 3 == 0 {
            recorder.sample(topics[1], &meta(T0 + at * MS, ms as u64), &[8; 3000]).unwrap();
        }
        recorder.advance(T0 + ms * MS).unwrap();
        for lambda in lambdas {
            let kinds: &[TriggerKind] = match random.below(300) {
                0 => &[Start],
                1..6 => &[Stop],
                6 | 7 => EVENT,
                _ => continue,
            };
            recorder.wake(lambda, &entry(T0 + ms * MS, kinds)).unwrap();
        }
        let steps = pace.below(40) - 30;
        for _ in 0..if is_live { steps.max(0) } else { 0 } {
            recorder.work().unwrap();
        }
    }
    recorder.finish(T0 + 3000 * MS).unwrap();
    recorder.clips().iter().map(|clip| scratch.contents(clip)).collect()
}

#[test]
fn clips_are_those_of_a_replay_whenever_the_work_is_done() {
    let mut clips = 0;
    for seed in 0..60 {
        let expected = random_drive(seed, false);
        clips += expected.len();
        assert_eq!(random_drive(seed, true), expected, "seed {seed}");
    }
    assert!(clips > 120, "{clips}");
}

#[test]
fn consecutive_clips_contain_everything_once_whenever_the_work_is_done() {
    for every in [1, 7, 60] {
        let scratch = TestDir::new();
        let mut recorder =
            live(&scratch, |settings| settings.max_length = Duration::from_millis(100));
        let (a, lambda) = add_hello(&mut recorder, (250, 0, 0));
        for ms in 0..2000 {
            recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
            match ms {
                1000 => recorder.wake(lambda, &entry(T0 + ms * MS, &[Start])).unwrap(),
                1600 => recorder.wake(lambda, &entry(T0 + ms * MS, &[Stop])).unwrap(),
                _ => {}
            }
            if ms % every == 0 {
                recorder.work().unwrap();
            }
        }
        recorder.finish(T0 + 2000 * MS).unwrap();
        let clips = recorder.clips();
        let all: Vec<_> = clips.iter().flat_map(|clip| stamps(&scratch, clip, "/a")).collect();
        assert_eq!(all, (750..=1600).collect::<Vec<_>>(), "work is done every {every} ms");
        assert_eq!(clips.len(), 9);
    }
}

#[test]
fn the_queue_to_the_disk_is_bounded_however_fast_samples_come() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |settings| settings.preroll_bytes = 256 << 20);
    let (a, lambda) = add_hello(&mut recorder, (1000, 1000, 0));
    let mut noise = SeededRandom(1);
    let bytes: Vec<u8> = (0..1 << 20).map(|_| noise.below(256) as u8).collect();
    let mut highest = 0;
    for ms in 0..200 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), &bytes).unwrap();
        if ms == 50 {
            recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
        }
        recorder.work().unwrap();
        highest = highest.max(recorder.counts().in_flight);
    }
    while recorder.work().unwrap() != Work::Done {
        highest = highest.max(recorder.counts().in_flight);
    }
    recorder.finish(T0 + 200 * MS).unwrap();
    assert!(highest <= (16 << 20) + (2 << 20), "{highest}");
    let clip = &recorder.clips()[0];
    assert_eq!(stamps(&scratch, clip, "/a"), (0..200).collect::<Vec<_>>());
    let expected = [
        "the preroll begins 0.9 s late: nothing was recorded before",
        "the recording was stopped before the window ended",
    ];
    assert_eq!(clip.incomplete, expected);
}

#[test]
fn samples_evicted_before_they_are_written_are_counted() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |settings| settings.preroll_bytes = 50_000);
    let (a, lambda) = add_hello(&mut recorder, (100, 1000, 0));
    for ms in 0..2000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), &[1; 100]).unwrap();
        if ms == 500 {
            // No time to work.
            recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
        }
    }
    recorder.finish(T0 + 2000 * MS).unwrap();
    let clip = &recorder.clips()[0];
    let topic = &clip.topics[0];
    assert!(topic.overwritten.unwrap() > 500, "{topic:?}");
    assert_eq!((topic.received, topic.lost), (Some(1101), Some(0)));
    assert_eq!(topic.messages + topic.overwritten.unwrap(), 1101);
}

#[test]
fn gaps_in_sequence_numbers_are_losses_of_their_clip() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |_| {});
    let topics = ["/a", "/b"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let late = recorder.add_missing_topic("/late").unwrap();
    let wanted = [topics[0], topics[1], late];
    let lambda = recorder.add_lambda(member("hello", (100, 100, 0), &wanted));
    let other = SampleMeta { writer: Guid([8; 16]), ..meta(0, 0) };
    for ms in 0..1000_u64 {
        let at = T0 + ms as i64 * MS;
        // Three are lost before the clip, five in its preroll, two in its postroll, four after it.
        let seq = ms
            + [(100, 3), (450, 5), (550, 2), (800, 4)]
                .iter()
                .filter(|(from, _)| ms >= *from)
                .map(|(_, lost)| lost)
                .sum::<u64>();
        recorder.sample(topics[0], &meta(at, seq), b"x").unwrap();
        if ms % 2 == 0 {
            // One comes late, and is not lost; another does not come.
            let swapped = match ms {
                540 => 542,
                542 => 540,
                ms => ms,
            };
            let meta = SampleMeta { at_ns: at, seq: swapped / 2 + 1, ..other };
            if ms != 520 {
                recorder.sample(topics[1], &meta, b"y").unwrap();
            }
        }
        match ms {
            480 => recorder.found_topic(late, topic("/late"), at).unwrap(),
            500 => {
                recorder.lost_wakes(lambda, at, 3);
                recorder.wake(lambda, &entry(at, EVENT)).unwrap();
            }
            510.. => recorder.sample(late, &meta(at, ms), b"z").unwrap(),
            _ => {}
        }
        recorder.work().unwrap();
    }
    recorder.finish(T0 + S).unwrap();
    let [clip] = recorder.clips() else { panic!() };
    let counts: Vec<_> = clip.topics.iter().map(|topic| (topic.messages, topic.lost)).collect();
    assert_eq!(counts, [(201, Some(7)), (100, Some(1)), (91, None)]);
    assert_eq!(clip.topics[2].type_name.as_deref(), Some("test_msgs/msg/Number"));
    let expected = [
        "7 samples of /a did not reach the recorder",
        "1 sample of /b did not reach the recorder",
        "/late was found 0.1 s after the clip begins",
        "the journal of hello lacks 3 wakes: lost in transit to the recorder",
    ];
    assert_eq!(clip.incomplete, expected);
    assert_eq!(scratch.journal(clip, "hello").0.wakes_before, 3);
}

/// Records an event at `event_ms`, with windows of 100 ms, while there is no ingress from 550 to
/// 650 ms; returns the lost samples of two topics. The second has two writers, of which one sends
/// nothing from 530 to 750 ms, and then its next sample.
fn lost_in_an_outage(event_ms: i64) -> Vec<Option<u64>> {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |_| {});
    let topics = ["/a", "/b"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let lambda = recorder.add_lambda(member("hello", (100, 100, 0), &topics));
    for ms in 0..1000_i64 {
        let at = T0 + ms * MS;
        match ms {
            // The end is noticed later than it is.
            555 => recorder.note_ingress(T0 + 550 * MS, at, false),
            650 => recorder.note_ingress(at, at, true),
            _ => {}
        }
        if !(551..=650).contains(&ms) {
            recorder.sample(topics[0], &meta(at, ms as u64), b"x").unwrap();
            recorder.sample(topics[1], &meta(at, ms as u64), b"y").unwrap();
        }
        if !(530..=750).contains(&ms) {
            let seq = if ms < 530 { ms } else { ms - 221 };
            let other = SampleMeta { writer: Guid([8; 16]), ..meta(at, seq as u64) };
            recorder.sample(topics[1], &other, b"z").unwrap();
        }
        if ms == event_ms {
            recorder.wake(lambda, &entry(at, EVENT)).unwrap();
        }
        while recorder.work().unwrap() == Work::More {}
    }
    recorder.finish(T0 + S).unwrap();
    let [clip] = recorder.clips() else { panic!() };
    let is_stated = clip.incomplete.iter().any(|why| why.contains("the ingress had ended"));
    assert_eq!(is_stated, (450..=750).contains(&event_ms), "{clip:?}");
    clip.topics.iter().map(|topic| topic.lost).collect()
}

#[test]
fn losses_without_an_ingress_are_known_to_the_clip_that_has_the_next_sample_of_each_writer() {
    assert_eq!(lost_in_an_outage(400), [Some(0), Some(0)], "before it");
    assert_eq!(lost_in_an_outage(500), [None, None], "it ends meanwhile");
    assert_eq!(lost_in_an_outage(600), [Some(100), None], "one writer has sent nothing since");
    assert_eq!(lost_in_an_outage(680), [Some(100), Some(100)], "both have");
    assert_eq!(lost_in_an_outage(800), [Some(0), Some(0)], "after it");
}

#[test]
fn while_recording_is_suspended_triggers_are_counted_and_the_open_clip_ends() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |_| {});
    let (a, lambda) = add_hello(&mut recorder, (50, 500, 0));
    for ms in 0..2000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
        match ms {
            100 | 400 | 1000 => recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap(),
            300 => recorder.hold(Some("the disk is full")).unwrap(),
            600 => recorder.hold(None).unwrap(),
            _ => {}
        }
        while recorder.work().unwrap() == Work::More {}
    }
    recorder.finish(T0 + 2 * S).unwrap();
    let [early, whole] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
    assert_eq!(stamps(&scratch, early, "/a"), every(50, 300, 1));
    assert_eq!(early.incomplete, ["the disk is full"]);
    assert_eq!((stamps(&scratch, whole, "/a"), whole.incomplete.len()), (every(950, 1500, 1), 0));
    assert_eq!(recorder.counts().recording.disk_suppressed, 1);
}

#[test]
fn the_end_of_a_lambda_stops_its_recordings() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |_| {});
    let (a, lambda) = add_hello(&mut recorder, (0, 50, 0));
    for ms in 0..1000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
        match ms {
            100 => recorder.wake(lambda, &entry(T0 + ms * MS, &[Start])).unwrap(),
            300 => recorder.end_lambda(lambda, T0 + ms * MS).unwrap(),
            _ => {}
        }
        recorder.work().unwrap();
    }
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    assert_eq!(stamps(&scratch, clip, "/a"), every(100, 350, 1));
    assert_eq!(clip.incomplete, ["hello ended before its stop trigger"]);
}

#[test]
fn a_clip_that_cannot_be_written_is_reported_and_the_next_one_is_written() {
    let scratch = TestDir::new();
    let mut recorder = live(&scratch, |_| {});
    let (a, lambda) = add_hello(&mut recorder, (0, 50, 0));
    let clips = scratch.0.join("clips");
    for ms in 0..2000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
        match ms {
            90 => std::fs::rename(&clips, scratch.0.join("away")).unwrap(),
            100 | 1000 => recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap(),
            500 => {
                while recorder.counts().recording.failed == 0 {
                    recorder.work().unwrap();
                }
                assert_eq!(recorder.take_failures().len(), 1);
                std::fs::rename(scratch.0.join("away"), &clips).unwrap();
            }
            _ => {}
        }
        recorder.work().unwrap();
    }
    recorder.finish(T0 + 2 * S).unwrap();
    let [clip] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
    assert_eq!(stamps(&scratch, clip, "/a"), every(1000, 1050, 1));
    assert_eq!(recorder.counts().recording.failed, 1);
}

#[test]
fn a_growing_preroll_keeps_its_entries() {
    for store in [Store::Ram, Store::Disk] {
        let scratch = TestDir::new();
        let mut recorder = live(&scratch, |settings| settings.preroll_bytes = 30_000);
        let (a, lambda) = add_hello(&mut recorder, (1000, 300, 0));
        for ms in 0..2000 {
            recorder.sample(a, &meta(T0 + ms * MS, ms as u64), &[1; 8]).unwrap();
            match ms {
                300 => recorder.grow_preroll(store, 64 << 20).unwrap(),
                1000 => recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap(),
                // In the middle of the backfill.
                1003 => recorder.grow_preroll(store, 65 << 20).unwrap(),
                _ => {}
            }
            if ms % 5 == 0 {
                recorder.work().unwrap();
            }
        }
        recorder.finish(T0 + 2 * S).unwrap();
        assert_eq!(stamps(&scratch, &recorder.clips()[0], "/a"), every(0, 1300, 1));
    }
}

#[test]
fn the_oldest_clips_are_deleted_and_each_is_noted() {
    let scratch = TestDir::new();
    let (mut folder, _) = RecordingFolder::open(&scratch.0).unwrap();
    assert!(folder.keep_at_most(Some(2), None).unwrap().is_empty());
    let settings = Settings { preroll_bytes: 1 << 20, ..scratch.settings() };
    let mut recorder = Recorder::live(folder, settings).unwrap();
    let (a, lambda) = add_hello(&mut recorder, (0, 50, 0));
    for ms in 0..1000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
        if ms % 200 == 100 {
            recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
        }
        recorder.work().unwrap();
    }
    recorder.finish(T0 + S).unwrap();
    let is_there: Vec<_> =
        recorder.clips().iter().map(|clip| scratch.0.join(&clip.file).exists()).collect();
    assert_eq!(is_there, [false, false, false, true, true]);
    let losses = std::fs::read_to_string(scratch.0.join("losses.jsonl")).unwrap();
    assert_eq!(losses.lines().count(), 3);
    for (line, clip) in losses.lines().zip(recorder.clips().to_vec()) {
        assert!(line.contains(&format!(r#""file":"{}""#, clip.file.display())), "{line}");
    }
    assert_eq!((recorder.counts().recording.deleted, recorder.take_deleted().len()), (3, 3));
}

#[test]
fn a_fetched_clip_does_not_count() {
    let scratch = TestDir::new();
    let (folder, _) = RecordingFolder::open(&scratch.0).unwrap();
    let settings = Settings { preroll_bytes: 1 << 20, ..scratch.settings() };
    let mut recorder = Recorder::live(folder, settings.clone()).unwrap();
    let (a, lambda) = add_hello(&mut recorder, (0, 50, 0));
    for ms in 0..600 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), b"x").unwrap();
        if ms % 200 == 100 {
            recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
        }
    }
    recorder.finish(T0 + S).unwrap();
    let files: Vec<_> = recorder.clips().iter().map(|clip| scratch.0.join(&clip.file)).collect();
    drop(recorder);
    let [oldest, second, third] = &files[..] else { panic!("{files:?}") };
    std::fs::remove_file(second).unwrap();
    // Two are left, and two are allowed.
    let (mut folder, _) = RecordingFolder::open(&scratch.0).unwrap();
    assert!(folder.keep_at_most(Some(2), None).unwrap().is_empty());
    std::fs::remove_file(third).unwrap();
    let mut recorder = Recorder::live(folder, settings).unwrap();
    let (a, lambda) = add_hello(&mut recorder, (0, 50, 0));
    let at = T0 + 10 * S;
    recorder.sample(a, &meta(at, 1), b"x").unwrap();
    recorder.wake(lambda, &entry(at, EVENT)).unwrap();
    recorder.finish(at + S).unwrap();
    assert!(oldest.exists());
    assert_eq!((recorder.clips().len(), recorder.counts().recording.deleted), (1, 0));
}
