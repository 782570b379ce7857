//! Tests of files that are one drive, or several.

use std::path::{Path, PathBuf};

use gleaner_drives::{DriveOptions, Replay, ReplayError};

use crate::support::{Written, drive, listen, run, small_chunks};

const SECOND: u64 = 1_000_000_000;

/// Writes a drive with a message of `topic` at both times, in s; without any if they are equal.
fn made(folder: &Path, (name, topic, first, last): (&str, &'static str, u64, u64)) -> PathBuf {
    let message = |at| Written { topic, at: at * SECOND, sequence: 1, value: 0 };
    let messages = if first == last { vec![] } else { vec![message(first), message(last)] };
    let path = folder.join(name);
    std::fs::write(&path, drive(small_chunks(), &messages)).unwrap();
    path
}

fn opened(paths: &[PathBuf]) -> Result<Vec<Vec<PathBuf>>, ReplayError> {
    match Replay::open_as(paths, &DriveOptions::default()) {
        Ok(_) => Ok(vec![paths.to_vec()]),
        Err(ReplayError::Separate { drives }) => Ok(drives),
        Err(error) => Err(error),
    }
}

#[test]
fn files_of_one_recording_and_of_one_vehicle_are_a_drive() {
    let folder = tempfile::tempdir().unwrap();
    // The number of the drive of each file.
    type Files<'a> = &'a [((&'a str, &'static str, u64, u64), usize)];
    let cases: &[Files<'_>] = &[
        // At the same time, with other topics.
        &[(("x.mcap", "/a", 1, 11), 0), (("y.mcap", "/b", 3, 13), 0)],
        &[(("x.mcap", "/a", 1, 11), 0), (("y.mcap", "/b", 12, 13), 1)],
        // A recorder that goes on in another file writes some messages late.
        &[(("x.mcap", "/a", 1, 11), 0), (("y.mcap", "/a", 10, 20), 0)],
        &[(("x.mcap", "/a", 10, 20), 0), (("y.mcap", "/a", 1, 11), 0)],
        &[(("x.mcap", "/a", 1, 11), 0), (("y.mcap", "/a", 12, 20), 1)],
        // The next file by number and time.
        &[(("day_0.mcap", "/a", 1, 11), 0), (("day_1.mcap", "/a", 12, 20), 0)],
        &[(("day_1.mcap", "/a", 12, 20), 0), (("day_0.mcap", "/a", 1, 11), 0)],
        &[(("day_0.mcap", "/a", 1, 11), 0), (("day_1.mcap", "/a", 20, 30), 1)],
        &[(("day_0.mcap", "/a", 12, 20), 0), (("day_1.mcap", "/a", 1, 11), 1)],
        &[(("day_0.mcap", "/a", 1, 11), 0), (("day_2.mcap", "/a", 12, 20), 1)],
        &[(("day_0.mcap", "/a", 1, 11), 0), (("night_1.mcap", "/a", 12, 20), 1)],
        // Two vehicles, each with two recorders, and a file without messages.
        &[
            (("a.mcap", "/a", 1, 11), 0),
            (("b.mcap", "/a", 50, 60), 1),
            (("c.mcap", "/c", 55, 65), 1),
            (("d_7.mcap", "/c", 2, 9), 0),
            (("d_8.mcap", "/c", 12, 14), 0),
            (("empty.mcap", "/a", 0, 0), 0),
        ],
    ];
    for files in cases {
        let paths: Vec<_> = files.iter().map(|(file, _)| made(folder.path(), *file)).collect();
        let of = |drive: &usize| {
            let members = files.iter().zip(&paths).filter(move |((_, number), _)| number == drive);
            members.map(|(_, path)| path.clone()).collect::<Vec<_>>()
        };
        let expected: Vec<_> = [0, 1].iter().map(of).filter(|drive| !drive.is_empty()).collect();
        assert_eq!(opened(&paths).unwrap(), expected, "{files:?}");
    }
}

#[test]
fn recordings_of_one_topic_that_overlap_are_refused_without_merge() {
    let folder = tempfile::tempdir().unwrap();
    // The second one lies within the first.
    let files = [("x.mcap", "/a", 1, 11), ("y.mcap", "/a", 4, 5)];
    opened(&files.map(|file| made(folder.path(), file))).unwrap_err();
    let files = [("x.mcap", "/a", 1, 11), ("y.mcap", "/a", 3, 13)];
    let paths = files.map(|file| made(folder.path(), file));
    let error = opened(&paths).unwrap_err();
    assert!(error.to_string().ends_with("overlap in time, and both have topic `/a`"), "{error}");
    assert!(error.help().unwrap().contains("--merge"));
    let options = DriveOptions { merge: true, ..DriveOptions::default() };
    let mut merged = Replay::open_as(&paths, &options).unwrap();
    listen(&mut merged, &["/a"]);
    assert_eq!(run(&mut merged).0.len(), 4);
}

#[test]
fn a_message_without_a_possible_time_hides_no_next_file() {
    let folder = tempfile::tempdir().unwrap();
    let late = |at| Written { topic: "/a", at, sequence: 1, value: 0 };
    let first = folder.path().join("day_0.mcap");
    std::fs::write(&first, drive(small_chunks(), &[late(SECOND), late(u64::MAX)])).unwrap();
    let next = made(folder.path(), ("day_1.mcap", "/a", 3, 13));
    assert_eq!(opened(&[first.clone(), next.clone()]).unwrap().len(), 1);
    let other = made(folder.path(), ("other.mcap", "/a", 3, 13));
    assert_eq!(opened(&[first.clone(), other]).unwrap().len(), 2);
    let replay = Replay::open(&[first, next]).unwrap();
    assert_eq!((replay.start_ns(), replay.end_ns()), (Some(SECOND as i64), None));
}
