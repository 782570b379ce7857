//! Tests with other files under the names of a recorder's files: nothing is written through them,
//! and nothing blocks on them.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::support::*;
use crate::{RecordError, Recorder, RecordingFolder, Settings};
use gleaner_base::{Exit, Failure};
use gleaner_lambda::Clip;
use gleaner_lambda::TriggerKind::{Event, Start};
use gleaner_lambda::manifest::Store;
use gleaner_protocol::link::Loss;

const PRECIOUS: &str = "precious, and without a newline at its end";

fn pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

/// A file that must not be changed.
fn precious(scratch: &TestDir) -> PathBuf {
    let path = scratch.0.join("precious");
    fs::write(&path, PRECIOUS).unwrap();
    path
}

fn is_untouched(path: &Path) -> bool {
    fs::read_to_string(path).unwrap() == PRECIOUS
}

/// Creates something at the second path, the first being the precious file; and the expected error.
type Put = (fn(&Path, &Path), &'static str);

const IN_THE_WAY: [Put; 4] = [
    (|precious, path| symlink(precious, path).unwrap(), "it is a link"),
    (|precious, path| symlink(precious.with_extension("nothing"), path).unwrap(), "it is a link"),
    (|precious, path| fs::hard_link(precious, path).unwrap(), "the file has other hard links"),
    (|_, path| pipe(path), "it is not a regular file"),
];

/// Asserts that the error names the file, the reason, and the way out.
fn assert_refused(error: RecordError, path: &Path, why: &str) {
    let failure = Failure::from(error);
    let text = failure.to_string();
    assert!(text.contains(&format!("`{}`", path.display())) && text.contains(why), "{text}");
    assert!(text.contains("remove it, or choose another folder: --out DIR"), "{text}");
    assert_eq!(failure.exit, Exit::Internal);
}

fn one_clip(scratch: &TestDir, store: Store) -> Result<Vec<Clip>, RecordError> {
    let mut recorder = scratch.recorder(|settings| settings.store = store);
    let topics = [recorder.add_topic(topic("/a")).unwrap()];
    let lambda = recorder.add_lambda(member("hello", (500, 300, 0), &topics));
    for at in (0..2000).step_by(10) {
        recorder.sample(topics[0], &meta(T0 + at * MS, at as u64), b"x")?;
        if at == 1000 {
            recorder.wake(lambda, &entry(T0 + at * MS, &[Event]))?;
        }
    }
    recorder.finish(T0 + 2000 * MS)?;
    Ok(recorder.clips().to_vec())
}

#[test]
fn a_list_or_a_lock_that_is_not_a_regular_file_is_refused() {
    for name in ["clips.jsonl", "clips/.lock"] {
        for (put, why) in IN_THE_WAY {
            let scratch = TestDir::new();
            let precious = precious(&scratch);
            let path = scratch.0.join(name);
            fs::create_dir(scratch.0.join("clips")).unwrap();
            put(&precious, &path);
            assert_refused(RecordingFolder::open(&scratch.0).err().unwrap(), &path, why);
            assert!(is_untouched(&precious), "{name}: {why}");
            assert!(!precious.with_extension("nothing").exists());
        }
    }
}

#[test]
fn a_list_that_is_replaced_while_the_recorder_runs_is_not_written_to() {
    for (put, why) in IN_THE_WAY {
        let scratch = TestDir::new();
        let precious = precious(&scratch);
        let (mut folder, _) = RecordingFolder::open(&scratch.0).unwrap();
        let path = scratch.0.join("clips.jsonl");
        put(&precious, &path);
        assert_refused(folder.replace(&[]).err().unwrap(), &path, why);
        assert!(is_untouched(&precious), "{why}");
    }
}

#[test]
fn losses_are_written_to_a_regular_file_only() {
    for (put, why) in IN_THE_WAY {
        let scratch = TestDir::new();
        let precious = precious(&scratch);
        let (folder, _) = RecordingFolder::open(&scratch.0).unwrap();
        let path = scratch.0.join("losses.jsonl");
        put(&precious, &path);
        let loss = Loss::NotDeleted {
            at_ns: 0,
            file: "clips/a.mcap".into(),
            bytes: 1,
            reason: "why".to_owned(),
        };
        assert_refused(folder.losses().note(&loss).err().unwrap(), &path, why);
        assert!(is_untouched(&precious), "{why}");
    }
}

#[test]
fn a_folder_of_clips_or_of_the_preroll_that_is_a_link_is_refused() {
    let (scratch, elsewhere) = (TestDir::new(), TestDir::new());
    let clips = scratch.0.join("clips");
    symlink(&elsewhere.0, &clips).unwrap();
    assert_refused(RecordingFolder::open(&scratch.0).err().unwrap(), &clips, "it is a link");
    fs::remove_file(&clips).unwrap();
    fs::write(&clips, "").unwrap();
    assert_refused(RecordingFolder::open(&scratch.0).err().unwrap(), &clips, "it is not a folder");
    fs::remove_file(&clips).unwrap();
    let preroll = scratch.0.join("preroll");
    fs::write(elsewhere.0.join("0.chunk"), PRECIOUS).unwrap();
    symlink(&elsewhere.0, &preroll).unwrap();
    let settings = Settings { store: Store::Disk, ..scratch.settings() };
    let (folder, _) = RecordingFolder::open(&scratch.0).unwrap();
    let refused = Recorder::new(folder, settings).err().unwrap();
    assert_refused(refused, &preroll, "it is a link");
    assert!(is_untouched(&elsewhere.0.join("0.chunk")));
    assert_eq!(fs::read_dir(&elsewhere.0).unwrap().count(), 1, "nothing was created there");
}

#[test]
fn links_with_names_of_unfinished_files_are_replaced() {
    // A clip begins with a free name, and a list and the preroll with new files.
    for (put, why) in IN_THE_WAY {
        let scratch = TestDir::new();
        let precious = precious(&scratch);
        fs::create_dir_all(scratch.0.join("clips")).unwrap();
        let clip_name = "clips/hello-20180802T083452.000Z";
        for name in [
            &format!("{clip_name}.mcap.part"),
            &format!("{clip_name}-2.jpg.part"),
            "clips.jsonl.part",
        ] {
            put(&precious, &scratch.0.join(name));
        }
        RecordingFolder::open(&scratch.0).unwrap().0.replace(&[]).unwrap();
        let clips = one_clip(&scratch, Store::Disk).unwrap();
        assert_eq!(clips.len(), 1, "{why}");
        assert!(clips[0].file.to_str().unwrap().starts_with(clip_name), "{:?}", clips[0].file);
        assert_eq!(stamps(&scratch, &clips[0], "/a"), every(500, 1300, 10), "{why}");
        assert!(is_untouched(&precious), "{why}");
        assert!(!precious.with_extension("nothing").exists());
    }
}

#[test]
fn a_pipe_with_the_name_of_a_clip_does_not_block() {
    let scratch = TestDir::new();
    {
        let mut recorder = scratch.recorder(|_| {});
        let topics = [recorder.add_topic(topic("/a")).unwrap()];
        let lambda = recorder.add_lambda(member("hello", (500, 500, 0), &topics));
        drive(&mut recorder, &topics, (0, 3000, 10), &[(2000, lambda, &[Start])]);
        // It dies before anything is finished.
    }
    let parts =
        || fs::read_dir(scratch.0.join("clips")).unwrap().map(|entry| entry.unwrap().path());
    let part = parts().find(|path| path.to_str().unwrap().ends_with(".mcap.part")).unwrap();
    pipe(&part.with_extension(""));
    let (_, found) = RecordingFolder::open(&scratch.0).unwrap();
    assert_eq!(found.len(), 1);
    assert!(found[0].file.to_str().unwrap().ends_with("-2.mcap"), "{:?}", found[0].file);
}
