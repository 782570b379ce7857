//! Tests of the preroll by its clips: evicted entries are counted in the clip whose window covers
//! them.

use std::fs;

use super::support::*;
use crate::{RecordError, Recorder};
use gleaner_lambda::Clip;
use gleaner_lambda::manifest::Store;

/// 100 bytes each ms on `/a` with a window of 1 s before 2000 ms, in a store of `bytes`.
fn cut(store: Store, bytes: u64) -> (TestDir, Clip, u64) {
    let scratch = TestDir::new();
    let mut recorder =
        scratch.recorder(|settings| (settings.store, settings.preroll_bytes) = (store, bytes));
    let (a, lambda) = add_hello(&mut recorder, (1000, 100, 0));
    for ms in 0..3000 {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64), &[ms as u8; 100]).unwrap();
        within_bound(&recorder);
        if ms == 2000 {
            recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
        }
    }
    recorder.finish(T0 + S * 4).unwrap();
    assert_eq!(recorder.clips().len(), 1);
    let (clip, evicted_early) =
        (recorder.clips()[0].clone(), recorder.counts().recording.evicted_early);
    (scratch, clip, evicted_early)
}

fn within_bound(recorder: &Recorder) {
    let counts = recorder.counts();
    assert!(counts.preroll_bytes <= counts.preroll_highest);
    assert!(counts.preroll_highest <= counts.preroll_bound);
}

#[test]
fn evicted_samples_are_counted_in_the_clip_that_lacks_them() {
    for store in [Store::Ram, Store::Disk] {
        let (scratch, clip, evicted_early) = cut(store, 50_000);
        let topic = &clip.topics[0];
        let overwritten = topic.overwritten.unwrap();
        assert!(overwritten > 600, "50 kB hold some 290 samples of 100 bytes: {overwritten}");
        assert_eq!((topic.received, topic.messages + overwritten), (Some(1101), 1101));
        assert_eq!(scratch.contents(&clip).len() as u64, topic.messages);
        let stated = format!("{overwritten} samples of /a evicted from the preroll");
        assert_eq!(clip.incomplete, [format!("preroll_size is too small: {stated}")]);
        assert!(evicted_early > overwritten);
        let (_scratch, clip, evicted_early) = cut(store, 16 << 20);
        let expected = (Some(0), 0, vec![]);
        assert_eq!((clip.topics[0].overwritten, evicted_early, clip.incomplete), expected);
    }
}

#[test]
fn losses_that_cannot_be_counted_are_unknown() {
    let scratch = TestDir::new();
    let mut recorder = scratch.recorder(|settings| settings.preroll_bytes = 10_000);
    let (a, lambda) = add_hello(&mut recorder, (6000, 0, 0));
    drive(&mut recorder, &[a], (0, 6000, 1), &[(5999, lambda, EVENT)]);
    recorder.finish(T0 + 6000 * MS).unwrap();
    let clip = &recorder.clips()[0];
    let topic = &clip.topics[0];
    assert_eq!((topic.overwritten, topic.received, topic.too_big), (None, None, Some(0)));
    let is_stated = clip.incomplete.iter().any(|short| short.ends_with("more than counted"));
    assert!(is_stated, "{:?}", clip.incomplete);
}

#[test]
fn a_sample_larger_than_the_store_is_in_an_open_clip_and_counted_before_one() {
    for store in [Store::Ram, Store::Disk] {
        let scratch = TestDir::new();
        let mut recorder =
            scratch.recorder(|settings| (settings.store, settings.preroll_bytes) = (store, 5_000));
        let (a, lambda) = add_hello(&mut recorder, (1000, 1000, 0));
        recorder.sample(a, &meta(T0 - 1500 * MS, 1), &[0; 10]).unwrap();
        for (ms, bytes) in [(0, 10), (100, 10_000), (200, 10)] {
            recorder.sample(a, &meta(T0 + ms * MS, 2), &vec![1; bytes]).unwrap();
        }
        recorder.wake(lambda, &entry(T0 + 200 * MS, EVENT)).unwrap();
        recorder.sample(a, &meta(T0 + 300 * MS, 3), &[2; 10_000]).unwrap();
        // A second window over the same time counts nothing twice.
        recorder.wake(lambda, &entry(T0 + 400 * MS, EVENT)).unwrap();
        recorder.finish(T0 + 3 * S).unwrap();
        let clip = &recorder.clips()[0];
        assert_eq!(stamps(&scratch, clip, "/a"), [0, 200, 300]);
        assert_eq!((clip.topics[0].too_big, clip.topics[0].received), (Some(1), Some(4)));
        assert_eq!(clip.incomplete, ["1 sample of /a did not fit into the preroll: preroll_size"]);
        assert_eq!(recorder.counts().recording.too_big, 2);
    }
}

#[test]
fn evicted_wakes_are_missing_from_the_journal_and_reported() {
    let scratch = TestDir::new();
    let mut recorder = scratch.recorder(|settings| settings.preroll_bytes = 3_000);
    let (_, lambda) = add_hello(&mut recorder, (1000, 0, 0));
    for ms in 0..100 {
        recorder.wake(lambda, &entry(T0 + ms * MS, if ms == 99 { EVENT } else { &[] })).unwrap();
        within_bound(&recorder);
    }
    recorder.finish(T0 + 3 * S).unwrap();
    let clip = &recorder.clips()[0];
    let (header, wakes) = scratch.journal(clip, "hello");
    assert_eq!(header.wakes_before + wakes.len() as u64, 100);
    assert_eq!(wakes.last(), Some(&(T0 + 99 * MS)));
    let stated = format!(
        "the journal of hello lacks {} wakes: evicted from the preroll",
        header.wakes_before
    );
    assert!(clip.incomplete.contains(&stated), "{:?}", clip.incomplete);
}

#[test]
fn a_preroll_on_disk_is_deleted_at_the_end_and_its_failure_is_reported() {
    let scratch = TestDir::new();
    let mut recorder = scratch.recorder(|settings| settings.store = Store::Disk);
    let a = recorder.add_topic(topic("/a")).unwrap();
    recorder.sample(a, &meta(T0, 1), b"x").unwrap();
    let folder = scratch.0.join("preroll");
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
    drop(recorder);
    assert!(!folder.exists());
    let mut recorder = scratch.recorder(|settings| settings.store = Store::Disk);
    let a = recorder.add_topic(topic("/a")).unwrap();
    fs::remove_dir_all(&folder).unwrap();
    let error = recorder.sample(a, &meta(T0, 1), b"x").unwrap_err();
    let RecordError::Preroll { path, .. } = &error else { panic!("{error:?}") };
    assert!(path.starts_with(&folder), "{error:?}");
}
