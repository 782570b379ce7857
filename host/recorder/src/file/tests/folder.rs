use std::fs::{self, OpenOptions};
use std::io::Write;

use gleaner_protocol::link::Loss;

use super::super::RecordingFolder;
use super::super::durable::steps;
use super::*;
use crate::error::RecordError;

#[test]
fn a_name_is_given_once() {
    let (scratch, mut folder) = opened();
    let files = [record(&mut folder, "a"), record(&mut folder, "a"), record(&mut folder, "../a")]
        .map(|clip| clip.file);
    let expected = ["clips/a.mcap", "clips/a-2.mcap", "clips/-a.mcap"];
    assert_eq!(files.map(|file| file.to_str().unwrap().to_owned()), expected);
    // Not even after the clip was fetched and deleted.
    fs::remove_file(scratch.path("clips/a.mcap")).unwrap();
    fs::remove_file(scratch.path("clips/a.jpg")).unwrap();
    assert_eq!(record(&mut folder, "a").file.to_str(), Some("clips/a-3.mcap"));
}

#[test]
fn a_folder_is_held_by_one_recorder_until_its_last_clip_is_closed() {
    let (scratch, mut folder) = opened();
    let clip = folder.begin("a", &clip_header()).unwrap();
    drop(folder);
    let error = RecordingFolder::open(&scratch.0).err().expect("the folder is locked");
    assert!(matches!(&error, RecordError::Busy { folder } if *folder == scratch.0), "{error:?}");
    clip.finish(trailer()).unwrap();
    assert!(scratch.open().1.is_empty());
}

#[test]
fn a_torn_last_line_is_truncated_and_its_clip_listed_again() {
    let (scratch, mut folder) = opened();
    let clips = [record(&mut folder, "a"), record(&mut folder, "b")];
    drop(folder);
    let list = fs::read(scratch.path("clips.jsonl")).unwrap();
    let first = list.iter().position(|byte| *byte == b'\n').unwrap() + 1;
    for len in [0, 1, first - 1, first, first + 1, list.len() - 1, list.len()] {
        fs::write(scratch.path("clips.jsonl"), &list[..len]).unwrap();
        let (_, found) = scratch.open();
        let whole = list[..len].iter().filter(|byte| **byte == b'\n').count();
        let unlisted: Vec<_> = clips[whole..].iter().map(unlisted).collect();
        assert_eq!(found, unlisted, "{len} bytes");
        assert_eq!(scratch.listed(), [&clips[..whole], &unlisted].concat(), "{len} bytes");
    }
    fs::remove_file(scratch.path("clips.jsonl")).unwrap();
    let unlisted = clips.each_ref().map(unlisted);
    assert_eq!(scratch.open().1, unlisted);
    assert_eq!(scratch.listed(), unlisted);
}

#[test]
fn a_clip_that_is_damaged_or_of_another_program_is_not_listed() {
    let (scratch, mut folder) = opened();
    record(&mut folder, "a");
    drop(folder);
    let clip = fs::read(scratch.path("clips/a.mcap")).unwrap();
    fs::remove_file(scratch.path("clips.jsonl")).unwrap();
    for damaged in [clip[..clip.len() - 9].to_vec(), b"no clip".to_vec(), Vec::new()] {
        fs::write(scratch.path("clips/a.mcap"), &damaged).unwrap();
        assert!(scratch.open().1.is_empty());
        assert!(scratch.listed().is_empty());
        assert_eq!(fs::read(scratch.path("clips/a.mcap")).unwrap(), damaged);
    }
}

#[test]
fn files_of_other_programs_are_left_unchanged() {
    let (scratch, mut folder) = opened();
    record(&mut folder, "a");
    drop(folder);
    let foreign = [
        "notes.txt",
        "b.jpg",
        "b.jpg.part",
        "b.mcap",
        "c.mcap.part2",
        "c.mcap.part",
        ".mcap.part.swp",
    ];
    for name in foreign {
        fs::write(scratch.path("clips").join(name), b"precious").unwrap();
    }
    fs::create_dir(scratch.path("clips/d.mcap.part")).unwrap();
    let before = scratch.files();
    let (mut folder, found) = scratch.open();
    assert!(found.is_empty());
    assert_eq!(scratch.files(), before);
    assert_eq!(folder.replace(&[]).unwrap(), 1);
    for name in foreign {
        assert_eq!(fs::read(scratch.path("clips").join(name)).unwrap(), b"precious", "{name}");
    }
}

#[test]
fn replacing_keeps_the_given_clips() {
    let (scratch, mut folder) = opened();
    let [_, keep, _] = ["a", "b", "c"].map(|base| record(&mut folder, base));
    assert_eq!(folder.replace(std::slice::from_ref(&keep)).unwrap(), 2);
    assert_eq!(scratch.listed(), std::slice::from_ref(&keep));
    assert_eq!(scratch.files(), ["b.jpg", "b.mcap"]);
    let next = record(&mut folder, "a");
    assert_eq!(scratch.listed(), [keep, next]);
    assert_eq!(folder.replace(&[]).unwrap(), 2);
    assert_eq!(folder.replace(&[]).unwrap(), 0);
    assert!(scratch.files().is_empty() && scratch.listed().is_empty());
}

#[test]
fn a_replacement_that_dies_at_any_step_is_completed_or_not_begun() {
    let mut died = 0;
    for last in 0.. {
        let (scratch, mut folder) = opened();
        let [a, keep, c] = ["a", "b", "c"].map(|base| record(&mut folder, base));
        steps::restart(last);
        let replaced = folder.replace(std::slice::from_ref(&keep));
        steps::restart(usize::MAX);
        drop(folder);
        let (mut folder, found) = scratch.open();
        assert_eq!(found, [], "died after {last} steps; no list named these clips");
        let listed = scratch.listed();
        match listed.len() {
            1 => {
                assert_eq!(listed[0], keep);
                assert_eq!(scratch.files(), ["b.jpg", "b.mcap"]);
            }
            _ => {
                assert_eq!(listed, [a, keep, c], "died after {last} steps");
                assert_eq!(scratch.files().len(), 6, "died after {last} steps");
            }
        }
        // The note does not outlive the next clip of the same name.
        let next = record(&mut folder, "a");
        drop(folder);
        assert!(scratch.open().1.is_empty());
        assert!(scratch.listed().contains(&next) && scratch.0.join(&next.file).is_file());
        died += usize::from(replaced.is_err());
        if replaced.is_ok() {
            break;
        }
    }
    assert!(died > 6, "it died {died} times");
}

#[test]
fn a_hostile_note_deletes_no_more_than_a_list_does() {
    let (scratch, mut folder) = opened();
    let clip = record(&mut folder, "a");
    drop(folder);
    let victims = ["x.mcap", "clips/notes.txt"].map(|name| scratch.path(name));
    victims.iter().for_each(|victim| fs::write(victim, b"precious").unwrap());
    let files = ["clips/a.mcap", "clips/../x.mcap", "../x.mcap", "clips/notes.txt"];
    let lines = files
        .map(|file| format!("{{\"file\":\"{file}\",\"thumbnail\":\"clips/../x.jpg\"}}\n"))
        .concat();
    fs::write(scratch.path("clips/.replaced"), lines + "no line").unwrap();
    assert!(scratch.open().1.is_empty());
    assert!(scratch.path(clip.file.to_str().unwrap()).is_file(), "the list names it");
    assert!(victims.iter().all(|victim| fs::read(victim).unwrap() == b"precious"));
    assert!(!scratch.path("clips/.replaced").exists());
}

#[test]
fn lines_of_other_programs_survive_a_replacement() {
    let (scratch, mut folder) = opened();
    let [a, _] = ["a", "b"].map(|base| record(&mut folder, base));
    let list = scratch.path("clips.jsonl");
    let own = fs::read_to_string(&list).unwrap();
    let (first, second) = own.trim_end().split_once('\n').unwrap();
    // One line is longer than any that this program writes.
    let foreign = [
        "# notes",
        r#"{"file":"../x.mcap","thumbnail":null}"#,
        "",
        "\u{fffd}",
        &"[".repeat(17 << 20),
    ];
    let [notes, other, empty, odd, long] = foreign;
    fs::write(&list, [notes, first, other, empty, long, second, odd, ""].join("\n")).unwrap();
    let kept = [notes, other, empty, long, odd];
    let lines =
        || fs::read_to_string(&list).unwrap().lines().map(str::to_owned).collect::<Vec<_>>();
    for _ in 0..2 {
        folder.replace(std::slice::from_ref(&a)).unwrap();
        let found = lines();
        assert!(found[..5] == kept && found.len() == 6, "{} lines", found.len());
        assert_eq!(serde_json::from_str::<Clip>(&found[5]).unwrap(), a);
    }
    folder.replace(&[]).unwrap();
    assert!(lines() == kept);
    drop(folder);
    assert!(scratch.open().1.is_empty());
}

#[test]
fn the_longest_possible_line_can_be_read_again() {
    let (scratch, mut folder) = opened();
    // No character takes more room in JSON than a control character.
    let name = |n: u64| format!("{}{n:04}", "\u{1}".repeat(1020));
    let topic =
        |n: u64| TopicSchema { name: name(n), type_name: name(n), ..TopicSchema::default() };
    assert!(topic(1).check().is_ok());
    let counts = |n| ClipTopicCounts {
        topic: name(n),
        type_name: Some(name(n)),
        ..ClipTopicCounts::default()
    };
    let attributes =
        || Some(serde_json::Map::from_iter([("text".to_owned(), "y".repeat(2000).into())]));
    let long = ClipTrailer {
        topics: (0..256).map(counts).collect(),
        incomplete: (0..4 * 256)
            .map(|n| format!("there is less of {}: for a long reason", name(n)))
            .collect(),
        moments: (0..200)
            .map(|n| Moment { label: "\u{1}".repeat(128), attributes: attributes(), ..moment(n) })
            .collect(),
        ..trailer()
    };
    let clip = folder.begin("a", &clip_header()).unwrap().finish(long).unwrap();
    let len = fs::metadata(scratch.path("clips.jsonl")).unwrap().len();
    assert!((5 << 20..12 << 20).contains(&len), "{len} bytes");
    assert_eq!(scratch.listed(), std::slice::from_ref(&clip));
    drop(folder);
    let (mut folder, found) = scratch.open();
    assert!(found.is_empty(), "it is listed already");
    assert_eq!(folder.replace(&[]).unwrap(), 1);
}

#[test]
fn a_hostile_list_deletes_nothing_outside() {
    let (scratch, mut folder) = opened();
    let clip = record(&mut folder, "a");
    let victims =
        ["x.mcap", "x.jpg", "clips/notes.txt", "clips/deep/y.mcap"].map(|name| scratch.path(name));
    fs::create_dir(scratch.path("clips/deep")).unwrap();
    for victim in &victims {
        fs::write(victim, b"precious").unwrap();
    }
    let absolute = scratch.path("x.mcap").to_str().unwrap().to_owned();
    let inside = scratch.path("clips/a.mcap").to_str().unwrap().to_owned();
    let mut list = OpenOptions::new().append(true).open(scratch.path("clips.jsonl")).unwrap();
    for file in [
        "clips/../x.mcap",
        "../x.mcap",
        "x.mcap",
        "clips/notes.txt",
        "clips/deep/y.mcap",
        &absolute,
        &inside,
    ] {
        let line = serde_json::json!({ "file": file, "thumbnail": "clips/../x.jpg" });
        writeln!(list, "{line}").unwrap();
    }
    writeln!(list, r#"{{"file":"clips/none.mcap","thumbnail":"../x.jpg"}}"#).unwrap();
    writeln!(list, "no line at all\n{{}}\n[]\n{}", "[".repeat(5 << 20)).unwrap();
    drop((list, folder));
    let (mut folder, found) = scratch.open();
    assert!(found.is_empty());
    assert_eq!(folder.replace(&[]).unwrap(), 1);
    assert!(!scratch.path(clip.file.to_str().unwrap()).exists());
    for victim in &victims {
        assert_eq!(fs::read(victim).unwrap(), b"precious", "{}", victim.display());
    }
}

fn deleted(reported: &[Loss]) -> &str {
    let [Loss::Deleted { file, .. }] = reported else { panic!("{reported:?}") };
    file.to_str().unwrap()
}

#[test]
fn a_clip_that_cannot_be_deleted_is_reported_once_and_the_next_one_is_deleted() {
    let (scratch, mut folder) = opened();
    assert!(folder.keep_at_most(Some(2), None).unwrap().is_empty());
    let mut added = |base: &str| {
        let clip = record(&mut folder, base);
        folder.make_room(&clip)
    };
    assert!(added("a").is_empty() && added("b").is_empty());
    // A folder cannot be removed like a file.
    let (stuck, aside) = (scratch.path("clips/a.mcap"), scratch.path("aside"));
    fs::rename(&stuck, &aside).unwrap();
    fs::create_dir(&stuck).unwrap();
    let reported = added("c");
    let [Loss::NotDeleted { file, reason, .. }, Loss::Deleted { file: gone, .. }] = &reported[..]
    else {
        panic!("{reported:?}")
    };
    assert_eq!((file.to_str(), gone.to_str()), (Some("clips/a.mcap"), Some("clips/b.mcap")));
    assert!(reason.contains("cannot remove") && reason.contains("a.mcap"), "{reason}");
    let has = |name: &str| scratch.files().iter().any(|file| file == name);
    assert!(has("c.mcap") && !has("b.mcap"));
    // Both stay on the list, and the limit holds as far as possible.
    let reported = added("d");
    assert_eq!(deleted(&reported), "clips/c.mcap");
    fs::remove_dir(&stuck).unwrap();
    fs::rename(&aside, &stuck).unwrap();
    let reported = added("e");
    assert_eq!(deleted(&reported), "clips/a.mcap");
    let noted = fs::read_to_string(scratch.path("losses.jsonl")).unwrap();
    let noted: Vec<Loss> = noted.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let names = noted.iter().map(|loss| match loss {
        Loss::Deleted { file, .. } => format!("deleted {}", file.display()),
        Loss::NotDeleted { file, .. } => format!("not deleted {}", file.display()),
        other => panic!("{other:?}"),
    });
    assert_eq!(
        names.collect::<Vec<_>>(),
        [
            "deleted clips/a.mcap",
            "not deleted clips/a.mcap",
            "deleted clips/b.mcap",
            "deleted clips/a.mcap",
            "deleted clips/c.mcap",
            "deleted clips/a.mcap"
        ]
    );
}
