//! Tests of recovery: unfinished clips torn at every byte, and recoveries that die at every step.

use std::fs;
use std::path::Path;

use super::super::UnfinishedClip;
use super::super::clip_dir::{AGAIN, CLIP, PART};
use super::super::durable::steps;
use super::super::recover::Recovery;
use super::*;
use crate::error::RecordError;

/// Returns the bytes of an unfinished clip of `messages` messages, some of them in an open chunk.
fn part(messages: u64) -> Vec<u8> {
    let (scratch, mut folder) = opened();
    drop(begun(&mut folder, "a", messages));
    fs::read(scratch.path("clips/a.mcap.part")).unwrap()
}

/// Returns the folder of a recorder that died after it had written `part` of a clip.
fn died(part: &[u8]) -> TestDir {
    let scratch = TestDir::new();
    fs::create_dir(scratch.path("clips")).unwrap();
    fs::write(scratch.path("clips/a.mcap.part"), part).unwrap();
    scratch
}

/// Returns the number of messages in the closed chunks of an unfinished clip of `messages`
/// messages: five per second.
fn closed(messages: u64) -> u64 {
    messages.saturating_sub(1) / 5 * 5
}

fn files(clips: &[Clip]) -> Vec<&str> {
    clips.iter().map(|clip| clip.file.to_str().unwrap()).collect()
}

fn recovery(scratch: &TestDir) -> Recovery {
    RecordingFolder::open_without_recovery(&scratch.0).unwrap().take_unfinished()
}

/// Returns whether `numbers` are those of the first messages, without a gap.
fn is_prefix(numbers: &[u64]) -> bool {
    numbers.iter().enumerate().all(|(at, number)| at as u64 == *number)
}

#[test]
fn an_abandoned_clip_has_every_closed_chunk_after_any_number_of_messages() {
    for messages in 0..23 {
        let scratch = died(&part(messages));
        let (_, found) = scratch.open();
        assert_eq!(scratch.listed(), found);
        if closed(messages) == 0 {
            assert!(found.is_empty() && scratch.files().is_empty(), "{messages} messages");
            continue;
        }
        assert_eq!(scratch.files(), ["a.mcap"]);
        assert_eq!(numbers(&scratch.path("clips/a.mcap")).len() as u64, closed(messages));
    }
}

#[test]
fn a_recovered_clip_describes_itself_and_what_is_missing() {
    let torn = [part(13), vec![9; 3]].concat();
    let scratch = died(&torn);
    let (_, found) = scratch.open();
    let [clip] = found.as_slice() else { panic!("one clip, not {}", found.len()) };
    assert_eq!(clip.lambdas, [lambda()]);
    assert_eq!((clip.from_ns, clip.to_ns), (10 * SECOND, stamp(9)));
    assert_eq!((clip.first_ns, clip.last_ns), (Some(stamp(0)), Some(stamp(9))));
    assert_eq!((clip.triggers, clip.moments.as_slice()), (1, &[moment(12 * SECOND)][..]));
    let topic = &clip.topics[0];
    assert_eq!((topic.messages, topic.received, topic.too_big), (10, None, None));
    assert_eq!(clip.bytes, fs::metadata(scratch.path("clips/a.mcap")).unwrap().len());
    let recovered = clip.recovered.as_ref().unwrap();
    assert_eq!(recovered.lost_bytes, 3);
    assert_eq!(
        recovered.note,
        "the recorder died; messages after 2.250 s of the window are lost, \
         at most 1 s of them unless the power failed; so are journal and thumbnail"
    );
    assert_eq!(clip.incomplete, std::slice::from_ref(&recovered.note));
    let messages = replayed(&scratch.path("clips/a.mcap"));
    assert_eq!((&messages[0].0, messages[0].1.writer), (&imu(), meta(0, 1).writer));
}

#[test]
fn a_file_torn_at_any_byte_becomes_a_valid_clip_or_nothing() {
    let whole = part(14);
    let mut longest = 0;
    for len in 0..=whole.len() {
        let scratch = died(&whole[..len]);
        let (folder, found) = scratch.open();
        assert_eq!(scratch.listed(), found, "{len} bytes");
        if found.is_empty() {
            assert!(scratch.files().is_empty(), "{len} bytes: {:?}", scratch.files());
            assert_eq!(longest, 0, "{len} bytes");
            continue;
        }
        assert_eq!(scratch.files(), ["a.mcap"], "{len} bytes");
        let numbers = numbers(&scratch.path("clips/a.mcap"));
        assert!(is_prefix(&numbers) && numbers.len() >= longest, "{len} bytes: {numbers:?}");
        longest = numbers.len();
        drop(folder);
        let (_, again) = scratch.open();
        assert!(again.is_empty(), "{len} bytes");
    }
    assert_eq!(longest, 10);
}

#[test]
fn a_flipped_byte_never_gives_a_broken_clip() {
    let whole = part(11);
    for at in 0..whole.len() {
        let mut flipped = whole.clone();
        flipped[at] ^= 0x41;
        let scratch = died(&flipped);
        let (_, found) = scratch.open();
        for clip in &found {
            let numbers = numbers(&scratch.path(clip.file.to_str().unwrap()));
            assert!(is_prefix(&numbers), "byte {at}: {numbers:?}");
        }
        assert_eq!(scratch.listed(), found, "byte {at}");
    }
}

/// A power failure may tear a finished file at any byte. A file with its footer becomes the clip
/// unchanged.
#[test]
fn a_finished_file_that_was_not_renamed_is_recovered_completely() {
    let (source, mut folder) = opened();
    let finished = record(&mut folder, "a");
    let whole = fs::read(source.path("clips/a.mcap")).unwrap();
    for len in (0..whole.len()).step_by(7).chain([whole.len()]) {
        let scratch = died(&whole[..len]);
        fs::write(scratch.path("clips/a.jpg"), b"a picture").unwrap();
        fs::write(scratch.path("clips/a.jpg.part"), b"a pic").unwrap();
        let (_, found) = scratch.open();
        assert_eq!(scratch.listed(), found, "{len} bytes");
        match found.as_slice() {
            [] => assert!(scratch.files().is_empty(), "{len} bytes"),
            [clip] => {
                assert!(is_prefix(&numbers(&scratch.path("clips/a.mcap"))), "{len} bytes");
                assert_eq!(clip.thumbnail, finished.thumbnail);
                assert_eq!(*clip == unlisted(&finished), len == whole.len(), "{len} bytes");
                assert!(!scratch.path("clips/a.mcap.part").exists(), "{len} bytes");
            }
            more => panic!("{} clips", more.len()),
        }
    }
}

/// Returns the folder of a recorder that died after it had finished a clip, before the rename; the
/// clip as the next start lists it; and the bytes of its file.
fn died_before_the_rename() -> (TestDir, Clip, Vec<u8>) {
    let (source, mut folder) = opened();
    let finished = record(&mut folder, "a");
    let whole = fs::read(source.path("clips/a.mcap")).unwrap();
    let scratch = died(&whole);
    fs::write(scratch.path("clips/a.jpg"), b"a picture").unwrap();
    fs::write(scratch.path("clips/a.jpg.part"), b"a pic").unwrap();
    (scratch, unlisted(&finished), whole)
}

/// The dead recorder may not have synced the original. The copy is synced before the rename.
#[test]
fn a_finished_file_is_copied_before_it_is_renamed() {
    let (scratch, _, _) = died_before_the_rename();
    // There is no earlier copy, but its removal is tried.
    let cleanup = ["remove a.mcap.part2"];
    let expected = [
        "copy a.mcap.part2",
        "sync a.mcap.part2",
        "rename a.mcap",
        "sync clips",
        "append clips.jsonl",
        "sync gleaner",
        "remove a.jpg.part",
        "remove a.mcap.part",
    ];
    steps::restart(usize::MAX);
    scratch.open();
    let taken = steps::taken()
        .into_iter()
        .map(|step| if step.contains("gleaner-") { "sync gleaner".into() } else { step });
    assert_eq!(taken.collect::<Vec<_>>(), [&cleanup[..], &expected[..]].concat());
}

#[test]
fn a_finished_file_is_recovered_once_even_if_its_recovery_dies_at_every_step() {
    let mut died_at_steps = 0;
    for last in 0.. {
        let (scratch, finished, whole) = died_before_the_rename();
        // Both attempts die at the same step; the last one, below, does not.
        let mut is_done = false;
        for _ in 0..2 {
            steps::restart(last);
            let mut recovery = recovery(&scratch);
            is_done =
                std::iter::from_fn(|| recovery.next(&mut || true)).all(|result| result.is_ok());
        }
        steps::restart(usize::MAX);
        scratch.open();
        assert_eq!(scratch.listed(), std::slice::from_ref(&finished), "after {last} steps");
        assert_eq!(scratch.files(), ["a.jpg", "a.mcap"], "after {last} steps");
        assert_eq!(fs::read(scratch.path("clips/a.mcap")).unwrap(), whole, "after {last} steps");
        assert!(scratch.open().1.is_empty());
        died_at_steps += u64::from(!is_done);
        if is_done && last > 12 {
            break;
        }
    }
    assert!(died_at_steps >= 3, "{died_at_steps}");
}

#[test]
fn a_complete_clip_is_synced_before_it_is_listed() {
    let (scratch, finished, whole) = died_before_the_rename();
    fs::remove_file(scratch.path("clips/a.mcap.part")).unwrap();
    fs::write(scratch.path("clips/a.mcap"), whole).unwrap();
    steps::restart(usize::MAX);
    assert_eq!(scratch.open().1, [finished]);
    assert_eq!(steps::taken()[..3], ["sync a.mcap", "sync clips", "append clips.jsonl"]);
}

/// Each folder is one that a recovery leaves if it dies after some step.
#[test]
fn a_recovery_that_dies_at_any_step_is_repeated_without_duplicates() {
    let part = part(14);
    let done = died(&part);
    let (_, found) = done.open();
    let saved = fs::read(done.path("clips/a.mcap")).unwrap();

    // During the copy: it is truncated anywhere.
    for len in (0..saved.len()).step_by(11) {
        let scratch = died(&part);
        fs::write(scratch.path(&format!("clips/a{AGAIN}")), &saved[..len]).unwrap();
        let (_, again) = scratch.open();
        assert_eq!((again, scratch.listed()), (found.clone(), found.clone()));
        assert_eq!(scratch.files(), ["a.mcap"]);
    }
    // After the rename, before the clip is listed; then after it is listed.
    for is_listed in [false, true] {
        let scratch = died(&part);
        fs::write(scratch.path(&format!("clips/a{CLIP}")), &saved).unwrap();
        if is_listed {
            fs::copy(done.path("clips.jsonl"), scratch.path("clips.jsonl")).unwrap();
        }
        let (_, again) = scratch.open();
        assert_eq!(again, if is_listed { Vec::new() } else { found.clone() });
        assert_eq!(scratch.listed(), found);
        assert_eq!(scratch.files(), ["a.mcap"]);
    }
}

#[test]
fn another_file_with_the_name_of_the_clip_stays() {
    let scratch = died(&part(14));
    fs::write(scratch.path("clips/a.mcap"), b"not a clip").unwrap();
    let (_, found) = scratch.open();
    assert_eq!(found[0].file, Path::new("clips/a-2.mcap"));
    assert_eq!(fs::read(scratch.path("clips/a.mcap")).unwrap(), b"not a clip");
    assert_eq!(scratch.files(), ["a-2.mcap", "a.mcap"]);
    assert_eq!(numbers(&scratch.path("clips/a-2.mcap")).len(), 10);
}

#[test]
fn an_empty_unfinished_clip_is_removed_and_a_file_of_another_program_is_not() {
    for nothing in [&[][..], &[0; 10_000], b"\x89MCAP0\r\n"] {
        let scratch = died(nothing);
        assert!(scratch.open().1.is_empty());
        assert!(scratch.files().is_empty());
    }
    let mut foreign = part(14);
    let library = foreign.windows(8).position(|bytes| bytes == b"gleaner ").unwrap();
    foreign[library] = b'b';
    for foreign in [foreign.as_slice(), b"half a download", &[&[0; 9000][..], b"x"].concat()] {
        let scratch = died(foreign);
        assert!(scratch.open().1.is_empty());
        assert_eq!(fs::read(scratch.path(&format!("clips/a{PART}"))).unwrap(), foreign);
    }
}

#[test]
fn several_unfinished_clips_are_recovered_in_the_order_of_their_names() {
    let (scratch, mut folder) = opened();
    let mut open: Vec<UnfinishedClip> =
        ["b", "a", "b"].map(|base| folder.begin(base, &clip_header()).unwrap()).into();
    for clip in &mut open {
        add(clip, 0, 8);
    }
    drop((folder, open));
    let (_, found) = scratch.open();
    assert_eq!(files(&found), ["clips/a.mcap", "clips/b.mcap", "clips/b-2.mcap"]);
}

#[test]
fn a_clip_that_cannot_be_recovered_is_left_for_a_later_start_and_does_not_stop_recording() {
    let scratch = died(&part(14));
    fs::write(scratch.path("clips/b.mcap.part"), part(8)).unwrap();
    // A folder cannot be removed like a file.
    fs::create_dir(scratch.path(&format!("clips/a{AGAIN}"))).unwrap();
    for _ in 0..2 {
        let mut recovery = recovery(&scratch);
        let why = recovery.next(&mut || true).unwrap().unwrap_err();
        let RecordError::Recover { path, .. } = &why else { panic!("{why:?}") };
        assert!(path.ends_with("clips/a.mcap.part"), "{why:?}");
    }
    let (mut folder, found) = scratch.open();
    assert_eq!(files(&found), ["clips/b.mcap"]);
    assert_eq!(record(&mut folder, "a").file, Path::new("clips/a-2.mcap"));
    drop(folder);
    assert_eq!(fs::read(scratch.path("clips/a.mcap.part")).unwrap(), part(14));
    fs::remove_dir(scratch.path(&format!("clips/a{AGAIN}"))).unwrap();
    let (_, found) = scratch.open();
    assert_eq!(files(&found), ["clips/a.mcap"]);
}

#[test]
fn a_recovery_that_is_aborted_at_any_time_leaves_the_unfinished_clip() {
    let part = part(14);
    let (_, _, whole) = died_before_the_rename();
    for left in [part, whole] {
        let mut aborted = 0;
        for allowed in 0.. {
            let scratch = died(&left);
            let mut recovery = recovery(&scratch);
            let mut checks = 0;
            let recovered = recovery.next(&mut || {
                checks += 1;
                checks <= allowed
            });
            if let Some(recovered) = recovered {
                assert_eq!(scratch.listed(), [recovered.unwrap()]);
                break;
            }
            drop(recovery);
            assert_eq!(scratch.files(), ["a.mcap.part"], "after {allowed} checks");
            assert_eq!(fs::read(scratch.path("clips/a.mcap.part")).unwrap(), left);
            assert_eq!(scratch.open().1.len(), 1);
            aborted += 1;
        }
        assert!(aborted > 6, "{aborted}");
    }
}

#[test]
fn clips_are_begun_and_finished_while_another_is_recovered() {
    let scratch = died(&part(14));
    let mut folder = RecordingFolder::open_without_recovery(&scratch.0).unwrap();
    // Another file has the name of the recovered clip.
    fs::write(scratch.path("clips/a.mcap"), b"not a clip").unwrap();
    let mut recovery = folder.take_unfinished();
    let mut clips = 0;
    let result = recovery.next(&mut || {
        record(&mut folder, "a");
        clips += 1;
        true
    });
    let recovered = result.unwrap().unwrap();
    assert!(clips > 6, "{clips}");
    let mut files: Vec<_> = scratch.listed().into_iter().map(|clip| clip.file).collect();
    assert_eq!(files.pop(), Some(recovered.file.clone()));
    assert_eq!(files.len(), clips);
    assert!(!files.contains(&recovered.file));
    assert_eq!(numbers(&scratch.path(recovered.file.to_str().unwrap())).len(), 10);
    assert!(files.iter().all(|file| numbers(&scratch.path(file.to_str().unwrap())).len() == 6));
}
