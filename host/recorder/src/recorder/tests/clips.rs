//! Tests of a recorder, clip by clip: contents and description.

use std::time::Duration;

use super::support::*;
use crate::{RecordError, TOPICS_MAX, TopicSchema};
use gleaner_base::Explain;
use gleaner_lambda::TriggerKind::{Event, Start, Stop};
use gleaner_protocol::RecordingCounts;
use gleaner_test_support::drives::DiscardSink;

#[test]
fn a_clip_contains_exactly_its_window_and_describes_itself() {
    let (scratch, mut recorder) = TestDir::recording();
    let topics = ["/a", "/b"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let gone = recorder.add_missing_topic("/gone").unwrap();
    let lambda = recorder.add_lambda(member("hello", (500, 300, 0), &[topics[0], gone]));
    drive(
        &mut recorder,
        &topics,
        (0, 3000, 10),
        &[(100, lambda, &[]), (1136, lambda, EVENT), (1200, lambda, &[])],
    );
    assert_eq!(recorder.clips().len(), 1, "the clip is complete once no window can touch it");
    recorder.finish(T0 + 3000 * MS).unwrap();
    let clip = &recorder.clips()[0];
    assert_eq!(clip.file.to_str(), Some("clips/hello-20180802T083452.136Z.mcap"));
    assert_eq!(stamps(&scratch, clip, "/a"), every(636, 1436, 10));
    assert!(stamps(&scratch, clip, "/b").is_empty());
    assert_eq!((clip.from_ns, clip.to_ns), (T0 + 636 * MS, T0 + 1436 * MS));
    assert_eq!((clip.triggers, clip.moments.len(), clip.moments[0].label.as_str()), (1, 1, "here"));
    assert_eq!((clip.lambdas.len(), clip.lambdas[0].windows), (1, 1));
    assert_eq!(clip.lambdas[0].digest, "d1e5");
    let [a, missing] = &clip.topics[..] else { panic!("{:?}", clip.topics) };
    let counts = (a.messages, a.received, a.lost, a.overwritten, a.too_big);
    assert_eq!(counts, (80, Some(80), None, Some(0), Some(0)));
    assert_eq!((missing.topic.as_str(), missing.received), ("/gone", Some(0)));
    assert_eq!(missing.type_name, None);
    assert_eq!(clip.incomplete, ["no message of /gone was received before the clip ended"]);
    let (header, wakes) = scratch.journal(clip, "hello");
    assert_eq!((header.wakes_before, wakes), (1, vec![T0 + 1136 * MS, T0 + 1200 * MS]));
    let counts = recorder.counts();
    let expected = RecordingCounts { clips: 1, windows: 1, ..RecordingCounts::default() };
    assert_eq!((counts.recording, counts.out_of_order), (expected, 0));
}

fn latched() -> TopicSchema {
    let qos = "- history: keep_last\n  depth: 1\n  durability: transient_local\n".to_owned();
    TopicSchema { offered_qos: Some(qos), ..topic("/tf_static") }
}

#[test]
fn a_clip_begins_with_the_samples_of_latched_topics_that_were_valid_then() {
    let (scratch, mut recorder) = TestDir::recording();
    let [a, latched] = [topic("/a"), latched()].map(|topic| recorder.add_topic(topic).unwrap());
    let lambda = recorder.add_lambda(member("hello", (500, 300, 0), &[a, latched]));
    // Writers of a drive are unknown, so each earlier sample may still be valid.
    for (topic, at_ms, seq) in [(latched, 0, 1), (latched, 10, 2), (latched, 2900, 3), (a, 3000, 1)]
    {
        recorder.sample(topic, &meta(T0 + at_ms * MS, seq), b"12345678").unwrap();
    }
    recorder.wake(lambda, &entry(T0 + 3000 * MS, EVENT)).unwrap();
    recorder.sample(a, &meta(T0 + 9000 * MS, 2), b"12345678").unwrap();
    recorder.wake(lambda, &entry(T0 + 9000 * MS, EVENT)).unwrap();
    recorder.finish(T0 + 10_000 * MS).unwrap();
    let of_tf = |clip: &gleaner_lambda::Clip| -> Vec<_> {
        let contents = scratch.contents(clip).into_iter();
        contents.filter(|(topic, ..)| topic == "/tf_static").map(|(_, at, seq)| (at, seq)).collect()
    };
    let [first, second] = recorder.clips() else { panic!("two clips") };
    let at = |ms: i64| T0 + ms * MS;
    assert_eq!(of_tf(first), [(at(2500), 1), (at(2500), 2), (at(2900), 3)]);
    assert_eq!(of_tf(second), [(at(8500), 1), (at(8500), 2), (at(8500), 3)]);
    for clip in [first, second] {
        assert!(clip.incomplete.is_empty() && clip.topics[1].received == Some(3), "{clip:?}");
        // Only the first of them has a message of its own time.
        assert_eq!(scratch.channels(clip).len(), if clip == first { 3 } else { 2 });
    }
    let path = scratch.0.join(&first.file);
    let mut drive = gleaner_drives::Replay::open(&[path]).unwrap();
    let sink = std::sync::Arc::new(DiscardSink);
    for topic in gleaner_messages::transport::Transport::topics(&drive) {
        let spec = gleaner_messages::transport::TopicSpec {
            topic: topic.topic,
            type_name: topic.type_name,
            queue: 1,
            max_bytes: 8,
            qos: Default::default(),
        };
        gleaner_messages::transport::Transport::subscribe(&mut drive, &spec, sink.clone()).unwrap();
    }
    let mut latched = Vec::new();
    while let Some(step) = drive.step().unwrap() {
        latched.extend(step.meta.is_latched.then_some((step.meta.publish_ns, step.meta.seq)));
    }
    assert_eq!(latched, [(at(0), 1), (at(10), 2)]);
    // In a clip of that clip, they are samples like others.
    let again = TestDir::new();
    let mut recorder = again.recorder(|_| {});
    let latched = recorder.add_topic(topic("/tf_static")).unwrap();
    let lambda = recorder.add_lambda(member("hello", (500, 300, 0), &[latched]));
    let mark = gleaner_messages::transport::SampleMeta { is_latched: true, ..meta(T0, 1) };
    recorder.sample(latched, &mark, b"12345678").unwrap();
    recorder.note("no messages of /far".to_owned());
    recorder.wake(lambda, &entry(T0, EVENT)).unwrap();
    recorder.finish(T0 + S).unwrap();
    let [clip] = recorder.clips() else { panic!("one clip") };
    assert_eq!(again.channels(clip).len(), 1);
    assert_eq!(clip.incomplete.last().unwrap(), "no messages of /far");
}

#[test]
fn latched_samples_move_with_the_begin_of_a_clip() {
    let (scratch, mut recorder) = TestDir::recording();
    let [a, latched] = [topic("/a"), latched()].map(|topic| recorder.add_topic(topic).unwrap());
    let [short, long] = [("short", 100), ("long", 2000)]
        .map(|(name, preroll)| recorder.add_lambda(member(name, (preroll, 500, 0), &[a, latched])));
    for (topic, at_ms, seq) in [(latched, 0, 1), (a, 1500, 1), (latched, 1600, 2), (a, 3000, 2)] {
        recorder.sample(topic, &meta(T0 + at_ms * MS, seq), b"12345678").unwrap();
    }
    recorder.wake(short, &entry(T0 + 3000 * MS, EVENT)).unwrap();
    recorder.sample(a, &meta(T0 + 3100 * MS, 3), b"12345678").unwrap();
    recorder.wake(long, &entry(T0 + 3200 * MS, EVENT)).unwrap();
    recorder.finish(T0 + 5000 * MS).unwrap();
    let [clip] = recorder.clips() else { panic!("one clip") };
    assert_eq!(clip.from_ns, T0 + 1200 * MS);
    let of_tf = scratch.contents(clip).into_iter().filter(|(topic, ..)| topic == "/tf_static");
    let mut of_tf: Vec<_> = of_tf.map(|(_, at, seq)| ((at - T0) / MS, seq)).collect();
    of_tf.sort_unstable();
    // What was valid at both begins, and the one that came in between.
    assert_eq!(of_tf, [(1200, 1), (1600, 2), (2900, 1), (2900, 2)]);
}

#[test]
fn messages_are_written_byte_for_byte() {
    let (scratch, mut recorder) = TestDir::recording();
    let (a, lambda) = add_hello(&mut recorder, (500, 300, 0));
    let mut sample = meta(T0, 5);
    (sample.endian, sample.options, sample.publish_ns) =
        (gleaner_messages::Endian::Big, [3, 4], -9);
    recorder.sample(a, &sample, b"before").unwrap();
    recorder.wake(lambda, &entry(T0, EVENT)).unwrap();
    recorder.sample(a, &meta(T0, 6), b"after").unwrap();
    recorder.finish(T0 + S).unwrap();
    let data: Vec<_> = scratch
        .messages(&recorder.clips()[0])
        .into_iter()
        .map(|(_, _, seq, data)| (seq, data))
        .collect();
    assert_eq!(data, [(5, b"\0\0\x03\x04before".to_vec()), (6, b"\0\x01\0\0after".to_vec())]);
}

#[test]
fn lambdas_share_a_clip_each_with_its_own_topics() {
    let (scratch, mut recorder) = TestDir::recording();
    let topics = ["/a", "/b", "/both"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let [a, b, both] = topics;
    let first = recorder.add_lambda(member("first", (100, 100, 0), &[a, both]));
    let second = recorder.add_lambda(member("second", (800, 50, 0), &[both, b]));
    let wakes = [
        (1000, first, EVENT),
        (1150, second, EVENT),
        (950, second, &[] as &[_]),
        (300, second, &[]),
    ];
    drive(&mut recorder, &topics, (0, 4000, 10), &wakes);
    let [clip] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
    assert_eq!((clip.from_ns, clip.to_ns), (T0 + 350 * MS, T0 + 1200 * MS));
    assert_eq!(stamps(&scratch, clip, "/a"), every(900, 1100, 10));
    assert_eq!(stamps(&scratch, clip, "/b"), every(350, 1200, 10));
    assert_eq!(stamps(&scratch, clip, "/both"), every(350, 1200, 10));
    assert_eq!(lambda_names(clip), ["first", "second"]);
    assert_eq!(scratch.journal(clip, "first").1, [T0 + 1000 * MS]);
    let (header, wakes) = scratch.journal(clip, "second");
    // In order, though found backwards.
    assert_eq!((header.wakes_before, wakes), (1, vec![T0 + 950 * MS, T0 + 1150 * MS]));
}

#[test]
fn a_late_trigger_makes_the_same_clip_as_a_prompt_one() {
    let made = |late_ms: i64| {
        let (scratch, mut recorder) = TestDir::recording();
        let (a, lambda) = add_hello(&mut recorder, (500, 300, 0));
        drive(&mut recorder, &[a], (0, 2000 + late_ms, 10), &[]);
        recorder.wake(lambda, &entry(T0 + 2000 * MS, EVENT)).unwrap();
        drive(&mut recorder, &[a], (2000 + late_ms, 6000, 10), &[]);
        recorder.finish(T0 + 6000 * MS).unwrap();
        assert_eq!(recorder.clips().len(), 1);
        (scratch.contents(&recorder.clips()[0]), recorder.clips()[0].clone())
    };
    let (prompt, _) = made(1);
    for late in [100, 299, 300, 301, 1400] {
        let (contents, clip) = made(late);
        assert_eq!((contents == prompt, clip.incomplete), (true, vec![]), "{late} ms late");
    }
    let (contents, clip) = made(1700);
    assert!(contents.len() < prompt.len());
    assert_eq!(clip.incomplete, ["a trigger came late: samples of /a had left the preroll"]);
    assert_eq!(clip.topics[0].received, None, "the number is unknown");
}

#[test]
fn a_long_clip_continues_in_the_next_without_loss_or_duplicates() {
    let scratch = TestDir::new();
    let mut recorder = scratch.recorder(|settings| settings.max_length = Duration::from_secs(1));
    let topics = ["/a", "/b"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let [a, b] = topics;
    let first = recorder.add_lambda(member("first", (2500, 0, 0), &[a]));
    let second = recorder.add_lambda(member("second", (700, 100, 0), &[b]));
    let wakes: [(_, _, &[_]); 3] =
        [(3000, first, &[Start]), (4400, second, EVENT), (6000, first, &[Stop])];
    drive(&mut recorder, &topics, (0, 12_000, 10), &wakes);
    let clips = recorder.clips();
    let all: Vec<_> = clips.iter().flat_map(|clip| stamps(&scratch, clip, "/a")).collect();
    assert_eq!(all, every(500, 6000, 10), "in order, nothing lost, nothing twice");
    let mut all: Vec<_> = clips.iter().flat_map(|clip| stamps(&scratch, clip, "/b")).collect();
    all.sort();
    assert_eq!(all, every(3700, 4500, 10));
    assert_eq!(clips.len(), 6);
    for (index, clip) in clips.iter().enumerate() {
        let (first, last) = (index == 0, index + 1 == clips.len());
        let states = |sentence: &str| clip.incomplete.iter().any(|why| why == sentence);
        assert_eq!(states("continues the clip before"), !first, "{index}");
        assert_eq!(states("continues in the next clip, if there was more"), !last, "{index}");
        assert!(clip.to_ns - clip.from_ns <= S);
        if !first {
            assert_eq!(clip.from_ns, clips[index - 1].to_ns + 1);
        }
    }
    let wakes: u64 = clips.iter().map(|clip| clip.triggers).sum();
    assert_eq!(wakes, 3);
}

#[test]
fn a_jump_in_time_makes_no_empty_clips() {
    let scratch = TestDir::new();
    let mut recorder = scratch.recorder(|settings| settings.max_length = Duration::from_secs(1));
    let (a, lambda) = add_hello(&mut recorder, (100, 0, 0));
    drive(&mut recorder, &[a], (0, 500, 10), &[(400, lambda, &[Start])]);
    let year = 365 * 24 * 3600 * S;
    recorder.sample(a, &meta(T0 + year, 1), b"much later").unwrap();
    recorder.sample(a, &meta(i64::MAX, 2), b"at the end of time").unwrap();
    recorder.finish(T0).unwrap();
    let messages = recorder.clips().iter().map(|clip| clip.topics[0].messages);
    assert!(messages.eq([20, 1, 1]), "{:?}", recorder.clips());
}

#[test]
fn a_clip_that_is_open_at_the_end_of_the_drive_states_that() {
    let (_scratch, mut recorder) = TestDir::recording();
    let a = recorder.add_topic(topic("/a")).unwrap();
    let event = recorder.add_lambda(member("event", (5000, 5000, 0), &[a]));
    drive(&mut recorder, &[a], (0, 6000, 10), &[(3100, event, EVENT)]);
    recorder.finish(T0 + 6000 * MS).unwrap();
    let [clip] = recorder.clips() else { panic!() };
    let expected = [
        "the preroll begins 1.9 s late: nothing was recorded before",
        "the drive ended 2.1 s before the window did",
    ];
    assert_eq!(clip.incomplete, expected);
    assert_eq!(clip.to_ns, T0 + 8100 * MS);

    let (_scratch, mut recorder) = TestDir::recording();
    let a = recorder.add_topic(topic("/a")).unwrap();
    let start = recorder.add_lambda(member("start", (100, 0, 0), &[a]));
    drive(&mut recorder, &[a], (0, 1000, 10), &[(500, start, &[Start])]);
    recorder.finish(T0 + 1500 * MS).unwrap();
    let [clip] = recorder.clips() else { panic!() };
    assert_eq!(clip.incomplete, ["the drive ended before the lambda's stop trigger"]);
    assert_eq!((clip.to_ns, clip.topics[0].messages), (T0 + 1500 * MS, 60));
}

#[test]
fn samples_before_1970_or_out_of_order_are_counted() {
    let (scratch, mut recorder) = TestDir::recording();
    let a = recorder.add_topic(topic("/a")).unwrap();
    let missing = recorder.add_missing_topic("/gone").unwrap();
    let lambda = recorder.add_lambda(member("hello", (100, 100, 0), &[a]));
    recorder.sample(a, &meta(-1, 1), b"x").unwrap();
    recorder.sample(missing, &meta(T0, 1), b"x").unwrap();
    recorder.wake(lambda, &entry(-1, EVENT)).unwrap();
    recorder.sample(a, &meta(T0 + 50 * MS, 2), b"x").unwrap();
    recorder.sample(a, &meta(T0 + 40 * MS, 3), b"x").unwrap();
    recorder.wake(lambda, &entry(T0 + 50 * MS, EVENT)).unwrap();
    recorder.sample(a, &meta(T0 + 45 * MS, 4), b"x").unwrap();
    recorder.finish(T0 + S).unwrap();
    let counts = recorder.counts();
    assert_eq!((counts.recording.before_1970, counts.recording.topic_unknown), (2, 1));
    assert_eq!(counts.out_of_order, 2);
    assert_eq!(stamps(&scratch, &recorder.clips()[0], "/a"), [40, 45, 50]);
}

#[test]
fn the_number_of_topics_is_bounded() {
    let (_scratch, mut recorder) = TestDir::recording();
    for index in 0..TOPICS_MAX {
        recorder.add_topic(topic(&format!("/t{index}"))).unwrap();
    }
    assert!(recorder.add_topic(topic("/t7")).is_ok(), "an existing one");
    let refused = recorder.add_topic(topic("/more")).unwrap_err();
    assert!(matches!(refused, RecordError::TooManyTopics { most: TOPICS_MAX }));
}

#[test]
fn the_names_of_all_topics_fit_into_a_line_of_the_list() {
    let (_scratch, mut recorder) = TestDir::recording();
    let name = |index: usize| format!("/t{index:03}{}", "x".repeat(1000));
    let refused =
        (0..TOPICS_MAX).find_map(|index| recorder.add_topic(topic(&name(index))).err()).unwrap();
    assert!(matches!(refused, RecordError::LongNames { most: 262_144 }), "{refused}");
    assert!(refused.help().unwrap().contains("--topics"));
}

/// A grey image of 4x4 pixels.
fn image(grey: u8) -> Vec<u8> {
    // Stamp, and an empty frame ID of one byte.
    let mut cdr = vec![0; 16];
    cdr[8] = 1;
    for number in [4_u32, 4, 6] {
        cdr.extend(number.to_le_bytes());
    }
    cdr.extend(b"mono8\0\0\0");
    for number in [4_u32, 16] {
        cdr.extend(number.to_le_bytes());
    }
    cdr.extend([grey; 16]);
    cdr
}

#[test]
fn the_thumbnail_is_the_image_at_the_trigger() {
    let picture = |anchor_ms: i64| {
        let (scratch, mut recorder) = TestDir::recording();
        let camera = recorder.add_topic(topic("/camera")).unwrap();
        let lambda = recorder.add_lambda(member("hello", (500, 500, 0), &[camera]));
        for ms in 0..500 {
            if ms % 100 == 50 {
                recorder
                    .sample(camera, &meta(T0 + ms * MS, ms as u64), &image(ms as u8 / 2))
                    .unwrap();
            }
            if ms == anchor_ms {
                recorder.wake(lambda, &entry(T0 + ms * MS, EVENT)).unwrap();
            }
        }
        recorder.finish(T0 + S).unwrap();
        let clip = &recorder.clips()[0];
        assert!(clip.thumbnail.is_some());
        scratch.attachments(clip)["thumbnail.jpg"].clone()
    };
    assert_eq!(picture(60), picture(149), "the newest image before");
    assert_ne!(picture(60), picture(150));
    assert_eq!(picture(10), picture(60), "or the first one after");
}

#[test]
fn the_thumbnail_is_from_the_clip() {
    let (_scratch, mut recorder) = TestDir::recording();
    let topics = ["/a", "/camera"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let lambda = recorder.add_lambda(member("hello", (100, 100, 0), &topics));
    recorder.sample(topics[1], &meta(T0 + 10 * MS, 1), &image(10)).unwrap();
    drive(&mut recorder, &topics[..1], (20, 500, 10), &[(300, lambda, EVENT)]);
    recorder.finish(T0 + S).unwrap();
    let clip = &recorder.clips()[0];
    // The one image was long before.
    assert_eq!((clip.thumbnail.as_ref(), clip.topics[1].messages), (None, 0));
}

#[test]
fn a_silent_topic_has_a_channel_and_a_missing_one_has_none() {
    let (scratch, mut recorder) = TestDir::recording();
    let topics = ["/a", "/silent", "/other"].map(|name| recorder.add_topic(topic(name)).unwrap());
    let gone = recorder.add_missing_topic("/gone").unwrap();
    let lambda = recorder.add_lambda(member("hello", (100, 100, 0), &[topics[0], topics[1], gone]));
    let empty = recorder.add_lambda(member("empty", (0, 0, 0), &[topics[1]]));
    drive(&mut recorder, &topics[..1], (0, 1000, 10), &[(300, lambda, EVENT), (800, empty, EVENT)]);
    recorder.finish(T0 + S).unwrap();
    let [clip, without] = recorder.clips() else { panic!() };
    assert_eq!(scratch.channels(clip), ["/a", "/silent"]);
    assert_eq!(clip.topics.iter().map(|topic| topic.messages).collect::<Vec<_>>(), [21, 0, 0]);
    assert_eq!((scratch.channels(without), without.first_ns), (vec!["/silent".to_owned()], None));
}

#[test]
fn a_lambda_that_is_restarted_within_a_clip_is_listed_twice() {
    let (scratch, mut recorder) = TestDir::recording();
    let a = recorder.add_topic(topic("/a")).unwrap();
    let lambdas = [1, 2].map(|limit| {
        let mut member = member("hello", (100, 50, 0), &[a]);
        member.header.config.insert("limit".to_owned(), limit.into());
        recorder.add_lambda(member)
    });
    let wakes: [(_, _, &[_]); 2] = [(200, lambdas[0], &[Event]), (230, lambdas[1], &[Event])];
    drive(&mut recorder, &[a], (0, 500, 10), &wakes);
    recorder.finish(T0 + 500 * MS).unwrap();
    let [clip] = recorder.clips() else { panic!("{:?}", recorder.clips()) };
    let records = scratch.metadata(clip);
    let configs = records
        .iter()
        .filter(|(name, _)| name == "gleaner.lambda")
        .map(|(_, of)| of["config"].as_str());
    assert_eq!(configs.collect::<Vec<_>>(), [r#"{"limit":1}"#, r#"{"limit":2}"#]);
    for (journal, limit) in [("hello", 1), ("hello-2", 2)] {
        assert_eq!(scratch.journal(clip, journal).0.config["limit"], limit);
    }
}
