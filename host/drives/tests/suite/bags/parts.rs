//! Tests replays of a part of a drive, by time.

use std::fs;
use std::path::PathBuf;

use gleaner_drives::{Damage, Replay, ReplayError};

use super::bag::{database_in, folder};
use crate::support::{TOPICS, drive, expected, file, listen, run, small_chunks, ticking};

/// Returns the messages delivered of a part, and the error at its end.
fn part(path: &PathBuf, from_ns: i64, to_ns: i64) -> (Vec<(i64, i64)>, Option<ReplayError>) {
    let mut replay = Replay::open(std::slice::from_ref(path)).unwrap();
    replay.restrict(from_ns, to_ns);
    let memory = listen(&mut replay, &TOPICS);
    let (_, error) = run(&mut replay);
    (memory.values(), error)
}

#[test]
fn a_part_includes_its_first_time_and_not_its_last() {
    let messages = ticking(&TOPICS, 300, 1000);
    let folder = folder();
    let mcap = small_chunks();
    let unindexed = small_chunks().emit_summary_records(false).emit_summary_offsets(false);
    let runs = small_chunks().use_chunks(false);
    let mut paths: Vec<_> =
        [mcap, unindexed, runs].into_iter().map(|how| file(&drive(how, &messages))).collect();
    paths.push(database_in(&folder, &messages));
    for path in paths {
        for (from, to) in [
            (0, i64::MAX),
            (1000, 1010),
            (1500, 2500),
            (1505, 1515),
            (3990, i64::MAX),
            (3991, 9000),
            (0, 1000),
        ] {
            let (all, error) = part(&path, from, to);
            assert!(error.is_none(), "{}: {error:?}", path.display());
            let wanted: Vec<_> =
                expected(&messages).into_iter().filter(|(at, _)| (from..to).contains(at)).collect();
            assert_eq!(all, wanted, "{}, from {from} to {to}", path.display());
        }
    }
}

#[test]
fn damage_after_the_part_costs_no_message() {
    let messages = ticking(&TOPICS, 300, 1000);
    let bytes = drive(small_chunks(), &messages);
    let path = file(&bytes[..bytes.len() / 2]);
    let (all, error) = part(&path, 1200, 1400);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(all.len(), 20);
    let (all, error) = part(&path, 1200, 9000);
    assert!(all.len() > 20);
    assert!(matches!(error, Some(ReplayError::Damaged { .. })));
}

#[test]
fn a_part_of_a_truncated_database_before_the_cut_is_complete() {
    let folder = folder();
    let messages = ticking(&TOPICS, 3000, 1000);
    let path = database_in(&folder, &messages);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let (all, error) = part(&path, 1100, 1300);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(all.len(), 20);
    let replay = Replay::open(std::slice::from_ref(&path)).unwrap();
    assert_eq!((replay.start_ns(), replay.end_ns()), (Some(1000), None), "where it ended is lost");
    let (_, error) = part(&path, 1100, i64::MAX);
    assert!(matches!(
        error,
        Some(ReplayError::Damaged {
            what: Damage::Database(_) | Damage::DatabaseTruncated { .. },
            ..
        })
    ));
}
