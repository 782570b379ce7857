//! Tests with lowered limits, and of the state between wakes.

use gleaner_lambda::TriggerKind::{Event, Start};

use super::super::*;
use super::support::*;

fn recorder(
    scratch: &TestDir,
    rolls_ms: (i64, i64, i64),
    limits: RecorderLimits,
) -> (Recorder, TopicId, LambdaId) {
    let mut recorder = scratch.recorder(|_| {});
    recorder.set_limits(limits);
    let (a, lambda) = add_hello(&mut recorder, rolls_ms);
    (recorder, a, lambda)
}

fn wake(recorder: &mut Recorder, lambda: LambdaId, ms: i64) {
    recorder.wake(lambda, &entry(T0 + ms * MS, &[Event])).unwrap();
}

#[test]
fn a_journal_that_is_too_long_has_no_gap_and_states_what_is_missing() {
    let scratch = TestDir::new();
    let limits = RecorderLimits { part_bytes: 1 << 10, ..RecorderLimits::default() };
    let (mut recorder, a, lambda) = recorder(&scratch, (100, 50, 0), limits);
    drive(&mut recorder, &[a], (0, 100, 10), &[]);
    (100..140).for_each(|ms| wake(&mut recorder, lambda, ms));
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    let (header, wakes) = scratch.journal(clip, "hello");
    assert_eq!(header.wakes_before, 0);
    let kept = wakes.len() as i64;
    assert!((5..20).contains(&kept), "{kept}");
    assert_eq!(wakes, (0..kept).map(|n| T0 + (100 + n) * MS).collect::<Vec<_>>());
    let short =
        format!("the journal of hello lacks the last {} wakes: longer than 0 MiB", 40 - kept);
    assert!(clip.incomplete.contains(&short), "{:?}", clip.incomplete);
}

#[test]
fn the_journals_of_a_clip_are_bounded_together_and_each_states_what_is_missing() {
    let scratch = TestDir::new();
    let limits =
        RecorderLimits { part_bytes: 2 << 10, parts_bytes: 3 << 10, ..RecorderLimits::default() };
    let (mut recorder, a, first) = recorder(&scratch, (100, 50, 0), limits);
    let second = recorder.add_lambda(member("second", (100, 50, 0), &[a]));
    drive(&mut recorder, &[a], (0, 100, 10), &[]);
    (100..140).for_each(|ms| {
        [first, second].into_iter().for_each(|lambda| wake(&mut recorder, lambda, ms))
    });
    assert!(recorder.clips.progress.open().unwrap().journals().bytes() <= 3 << 10);
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    let mut lacking = 0;
    for name in ["hello", "second"] {
        let wakes = scratch.journal(clip, name).1;
        let kept = wakes.len() as i64;
        assert!((5..20).contains(&kept), "{kept}");
        assert_eq!(wakes, (0..kept).map(|n| T0 + (100 + n) * MS).collect::<Vec<_>>());
        lacking += 40 - kept;
        let short = format!(
            "the journal of {name} lacks the last {} wakes: \
             all journals together are longer than 0 MiB",
            40 - kept
        );
        assert!(clip.incomplete.contains(&short), "{:?}", clip.incomplete);
    }
    assert!(lacking > 40);
}

#[test]
fn a_clip_lists_as_many_moments_as_it_may_and_counts_all() {
    let scratch = TestDir::new();
    let limits = RecorderLimits { moments: 150, ..RecorderLimits::default() };
    let (mut recorder, a, lambda) = recorder(&scratch, (100, 50, 0), limits);
    drive(&mut recorder, &[a], (0, 100, 10), &[]);
    (100..300).for_each(|ms| wake(&mut recorder, lambda, ms));
    recorder.set_engine(lambda, "Python; model `m`: rten".to_owned());
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    assert_eq!((clip.triggers, clip.moments.len()), (200, Clip::MOMENTS_MAX));
    let records = scratch.metadata(clip);
    assert_eq!(records.iter().filter(|(name, _)| name == "gleaner.decision").count(), 150);
    let lambda =
        records.iter().find(|(name, _)| name == "gleaner.lambda").map(|(_, of)| of).unwrap();
    let stated = ["name", "engine", "gleaner", "config", "models", "digest", "windows"]
        .map(|key| lambda[key].as_str());
    assert_eq!(stated, ["hello", "Python; model `m`: rten", "0.1.0", "{}", "", "d1e5", "200"]);
    assert_eq!(RecorderLimits::default().moments, 10_000);
}

#[test]
fn triggers_beyond_the_waiting_limit_are_counted_in_their_clip() {
    let (_scratch, mut recorder) = TestDir::recording();
    recorder.set_limits(RecorderLimits { waiting: 20, ..RecorderLimits::default() });
    let a = recorder.add_topic(topic("/a")).unwrap();
    let noisy = recorder.add_lambda(member("noisy", (5, 0, 0), &[a]));
    // Its preroll holds each clip open for long, so that the windows of the other wait.
    let slow = recorder.add_lambda(member("slow", (400, 0, 0), &[a]));
    let mut wakes = vec![(10, noisy, &[Event] as &[_])];
    wakes.extend((100..300).map(|ms| (ms, noisy, &[Event] as &[_])));
    wakes.push((900, slow, &[Event]));
    drive(&mut recorder, &[a], (0, 2000, 1), &wakes);
    recorder.finish(T0 + 2000 * MS).unwrap();
    let counts: Vec<_> = recorder
        .clips()
        .iter()
        .map(|clip| (clip.triggers, clip.moments.len(), clip.incomplete.len()))
        .collect();
    let [first, second, third] = counts[..] else { panic!("{counts:?}") };
    assert_eq!((first.0, third.0), (1, 1));
    assert_eq!((second.0, second.2), (200, 0), "{:?}", recorder.clips()[1].incomplete);
    assert!(second.1 >= 20);
}

#[test]
fn a_clip_states_that_its_number_of_triggers_is_unknown() {
    let scratch = TestDir::new();
    // In the cooldown, triggers open no window; the next window reaches back over some of them.
    let limits = RecorderLimits { waiting: 10, ..RecorderLimits::default() };
    let (mut recorder, a, lambda) = recorder(&scratch, (50, 0, 200), limits);
    drive(&mut recorder, &[a], (0, 1, 1), &[]);
    (100..=300).for_each(|ms| wake(&mut recorder, lambda, ms));
    recorder.finish(T0 + S).unwrap();
    let [first, second] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
    let stated = "more triggers of hello than counted: too many waited for their clip";
    assert_eq!((first.triggers, first.incomplete.iter().any(|short| short == stated)), (1, false));
    assert!((10..51).contains(&second.triggers), "{}", second.triggers);
    assert!(second.incomplete.iter().any(|short| short == stated), "{:?}", second.incomplete);
}

#[test]
fn a_message_that_is_too_large_for_a_clip_is_counted_by_the_clip_that_covers_it() {
    let scratch = TestDir::new();
    let limits = RecorderLimits { message_bytes: 10, ..RecorderLimits::default() };
    let (mut recorder, a, lambda) = recorder(&scratch, (100, 100, 0), limits);
    for (ms, bytes) in [(50, 11), (60, 10)] {
        recorder.sample(a, &meta(T0 + ms * MS, 1), &[7; 20][..bytes]).unwrap();
    }
    wake(&mut recorder, lambda, 100);
    for (ms, bytes) in [(150, 11), (160, 10), (900, 11)] {
        recorder.sample(a, &meta(T0 + ms * MS, 1), &[7; 20][..bytes]).unwrap();
    }
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    let topic = &clip.topics[0];
    assert_eq!((topic.messages, topic.received, topic.too_big), (2, Some(4), Some(2)));
    assert_eq!(recorder.counts().recording.too_big, 3);
    let stated = "1 sample of /a larger than 0 MiB, too large for a clip";
    assert!(clip.incomplete.iter().any(|short| short == stated), "{:?}", clip.incomplete);
}

/// Each sample and each wake is visited a few times, not once for each trigger.
#[test]
fn a_lambda_that_triggers_in_every_wake_visits_only_new_entries() {
    for late_ms in [0, 7] {
        let scratch = TestDir::new();
        let (mut recorder, a, lambda) = recorder(&scratch, (1000, 0, 0), RecorderLimits::default());
        drive(&mut recorder, &[a], (0, 1000, 1), &[]);
        for ms in 1000..1500 {
            recorder.sample(a, &meta(T0 + ms * MS, ms as u64), &ms.to_le_bytes()).unwrap();
            wake(&mut recorder, lambda, ms - late_ms);
            // If it were visited again, it would be written again.
            let oldest = recorder.material.history.preroll.next(None).unwrap().place();
            recorder.material.history.preroll.mark(oldest, 0);
            let settled = recorder.clips.progress.open().unwrap().settled().unwrap();
            assert_eq!(settled.newest, T0 + (ms - late_ms) * MS);
            let mut left = 0;
            let mut next = recorder.material.history.preroll.next(Some(settled.last));
            while let Some(walked) = next {
                left += 1;
                next = recorder.material.history.preroll.next(Some(walked));
            }
            assert!(left <= 3 * late_ms, "{left} entries are visited again");
        }
        recorder.finish(T0 + 1500 * MS).unwrap();
        let clip = &recorder.clips()[0];
        assert_eq!(stamps(&scratch, clip, "/a"), every(0, 1499 - late_ms, 1));
        assert_eq!(scratch.journal(clip, "hello").1.len(), 500);
    }
}

/// The contents of the clips of a random drive: late triggers, samples out of order, windows with
/// different prerolls. With `forgets`, all entries are visited in every wake.
fn random_drive(seed: u64, forgets: bool) -> Vec<Vec<(String, i64, u32)>> {
    let mut random = SeededRandom(seed);
    let (scratch, mut recorder) = TestDir::recording();
    let a = recorder.add_topic(topic("/a")).unwrap();
    let rolls = [(random.below(8), 0), (random.below(300), random.below(20))];
    let lambdas = [0, 1]
        .map(|n| recorder.add_lambda(member(&format!("l{n}"), (rolls[n].0, rolls[n].1, 0), &[a])));
    for ms in 1000..1600 {
        let at = ms - random.below(3) * random.below(5);
        recorder.sample(a, &meta(T0 + at * MS, ms as u64), b"x").unwrap();
        for (lambda, rarely) in lambdas.iter().zip([6, 40]) {
            if let (true, Some(open_clip)) = (forgets, recorder.clips.progress.open()) {
                open_clip.unsettle();
            }
            if random.below(rarely) == 0 {
                wake(&mut recorder, *lambda, ms - random.below(2) * random.below(20));
            }
        }
    }
    recorder.finish(T0 + 1600 * MS).unwrap();
    recorder.clips().iter().map(|clip| scratch.contents(clip)).collect()
}

#[test]
fn visiting_only_new_entries_misses_nothing() {
    for seed in 0..60 {
        let clips = random_drive(seed, false);
        assert_eq!(clips, random_drive(seed, true), "seed {seed}");
        assert!(clips.iter().map(Vec::len).sum::<usize>() > 50);
        for mut messages in clips {
            let all = messages.len();
            messages.dedup();
            assert_eq!(messages.len(), all, "no message is in a clip twice");
        }
    }
}

#[test]
fn a_topic_with_a_long_description_is_refused() {
    let (_scratch, mut recorder) = TestDir::recording();
    let long = "x".repeat(64 << 10);
    let named = TopicSchema { name: long.clone(), ..topic("/a") };
    let typed = TopicSchema { type_name: long.clone(), ..topic("/a") };
    let defined = TopicSchema { definitions: Some("#".repeat(9 << 20).into()), ..topic("/a") };
    for (topic, what) in
        [(named, "name"), (typed, "type name"), (defined, "definitions and quality of service")]
    {
        let error = recorder.add_topic(topic).unwrap_err();
        let RecordError::LongTopic { what: found, .. } = &error else { panic!("{error:?}") };
        assert_eq!(*found, what);
        assert!(error.to_string().len() < 300);
    }
    assert!(recorder.add_missing_topic(&long).is_err());
    assert!(recorder.add_topic(topic("/a")).is_ok());
}

#[test]
fn a_long_recording_stays_settled() {
    let scratch = TestDir::new();
    let (mut recorder, a, lambda) = recorder(&scratch, (50, 0, 0), RecorderLimits::default());
    let second = recorder.add_lambda(member("second", (90, 0, 0), &[a]));
    let wakes: [(_, _, &[_]); 3] =
        [(200, lambda, &[Start]), (210, second, &[Event]), (205, second, &[])];
    drive(&mut recorder, &[a], (0, 300, 1), &wakes);
    recorder.finish(T0 + 300 * MS).unwrap();
    assert_eq!(stamps(&scratch, &recorder.clips()[0], "/a"), every(120, 299, 1));
}
