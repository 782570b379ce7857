//! Tests of a live recorder whose wakes arrive later than samples.

use std::time::Duration;

use super::support::*;
use crate::{LambdaId, Recorder, RecordingFolder, Settings, TopicId};
use gleaner_lambda::TriggerKind::{self, Event, Start, Stop};

/// A recorder with one topic and a lambda without preroll, so that nothing waits longer than it
/// must.
fn recorder(
    scratch: &TestDir,
    postroll_ms: i64,
    max_length_ms: u64,
) -> (Recorder, TopicId, LambdaId) {
    let max_length = Duration::from_millis(max_length_ms);
    let settings = Settings { max_length, clock: "monotonic".to_owned(), ..scratch.settings() };
    let folder = RecordingFolder::open(&scratch.0).unwrap().0;
    let mut recorder = Recorder::live(folder, settings).unwrap();
    let (a, lambda) = add_hello(&mut recorder, (0, postroll_ms, 0));
    (recorder, a, lambda)
}

/// A sample and a wake each ms from 0 to before `to_ms`. Wakes are sent together every 100 ms, or
/// with the next one that triggers.
fn late_drive(
    recorder: &mut Recorder,
    a: TopicId,
    lambda: LambdaId,
    to_ms: i64,
    triggers: &[(i64, TriggerKind)],
) {
    let mut wait = Vec::new();
    for ms in 0..to_ms {
        recorder.sample(a, &meta(T0 + ms * MS, ms as u64 + 1), &ms.to_le_bytes()).unwrap();
        let kinds: Vec<_> =
            triggers.iter().filter(|(at, _)| *at == ms).map(|(_, kind)| *kind).collect();
        wait.push(entry(T0 + ms * MS, &kinds));
        if !kinds.is_empty() || ms % 100 == 99 {
            wait.drain(..).for_each(|entry| recorder.wake(lambda, &entry).unwrap());
        }
        recorder.work().unwrap();
    }
    // The last ones are sent at the end.
    wait.drain(..).for_each(|entry| recorder.wake(lambda, &entry).unwrap());
}

#[test]
fn wakes_that_come_late_are_in_the_journals_of_their_clips() {
    let scratch = TestDir::new();
    let (mut recorder, a, lambda) = recorder(&scratch, 150, 600_000);
    late_drive(&mut recorder, a, lambda, 1500, &[(310, Event), (800, Event)]);
    recorder.finish(T0 + 1500 * MS).unwrap();
    let clips = recorder.clips();
    assert_eq!(clips.len(), 2);
    for (clip, from) in clips.iter().zip([310, 800]) {
        assert_eq!(clip.incomplete, [""; 0]);
        assert_eq!((clip.topics[0].lost, clip.topics[0].received), (Some(0), Some(151)));
        assert_eq!(stamps(&scratch, clip, "/a"), every(from, from + 150, 1));
        let wakes: Vec<_> =
            scratch.journal(clip, "hello").1.iter().map(|at| (at - T0) / MS).collect();
        assert_eq!(wakes, every(from, from + 150, 1));
    }
    assert_eq!(recorder.counts().out_of_order, 0);
}

#[test]
fn late_wakes_are_in_the_right_clip_of_a_long_recording() {
    let scratch = TestDir::new();
    let (mut recorder, a, lambda) = recorder(&scratch, 0, 300);
    late_drive(&mut recorder, a, lambda, 2000, &[(250, Start), (1490, Stop)]);
    recorder.finish(T0 + 2000 * MS).unwrap();
    let (mut samples, mut wakes) = (Vec::new(), Vec::new());
    for clip in recorder.clips() {
        let journal = scratch.journal(clip, "hello").1;
        let span = clip.from_ns..=clip.to_ns;
        assert!(journal.iter().all(|at| span.contains(at)), "{clip:?}: {journal:?}");
        wakes.extend(journal.iter().map(|at| (at - T0) / MS));
        samples.extend(stamps(&scratch, clip, "/a"));
    }
    assert_eq!(samples, every(250, 1490, 1));
    assert_eq!(wakes, every(250, 1490, 1));
    assert_eq!(recorder.clips().len(), 5);
}

#[test]
fn a_full_clip_that_waits_for_wakes_loses_nothing_at_the_end() {
    for is_held in [true, false] {
        let scratch = TestDir::new();
        let (mut recorder, a, lambda) = recorder(&scratch, 0, 300);
        // It is full at 400, and waits until 600.
        late_drive(&mut recorder, a, lambda, 500, &[(100, Start)]);
        assert_eq!(recorder.clips().len(), 0);
        if is_held {
            recorder.hold(Some("the disk is full")).unwrap();
            while recorder.is_recording() {
                recorder.work().unwrap();
            }
        }
        recorder.finish(T0 + 500 * MS).unwrap();
        let [full, rest] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
        assert_eq!(stamps(&scratch, full, "/a"), every(100, 400, 1));
        assert_eq!(stamps(&scratch, rest, "/a"), every(401, 499, 1));
        assert_eq!(scratch.journal(rest, "hello").1.len(), 99);
        let why = if is_held {
            "the disk is full"
        } else {
            "the recording was stopped before the window ended"
        };
        assert_eq!(rest.incomplete, ["continues the clip before", why]);
    }
}
