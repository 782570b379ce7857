//! Folders on the real disk: one writer, and nothing but plain files of its user.

use std::fs;
use std::os::unix::fs::{chown, symlink};
use std::path::Path;

use gleaner_spool::{BUDGET_MIN, SpoolError, SpoolItem, SpoolReader, SpoolWriter};
use rustix::fs::{CWD, FileType, Mode, mknodat};

use crate::model::{KIND, STREAM, TIME, config};

/// Puts something at the path of a segment.
type Plant<'a> = &'a dyn Fn(&Path);

fn open(path: &Path) -> Result<SpoolWriter, SpoolError> {
    SpoolWriter::open(path, config(BUDGET_MIN))
}

#[test]
fn a_second_writer_is_refused_with_the_process_of_the_first() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("logs");
    let writer = open(&path).unwrap();
    let Err(SpoolError::Busy { pid, .. }) = open(&path) else { panic!("a second writer") };
    // Some containers list no locks.
    assert!(pid.is_none_or(|pid| pid == std::process::id()), "{pid:?}");
    drop(writer);
    open(&path).unwrap();
}

#[test]
fn records_are_read_back_from_the_disk() {
    let scratch = tempfile::tempdir().unwrap();
    let mut writer = open(scratch.path()).unwrap();
    writer.append(KIND, TIME, b"one").unwrap();
    writer.commit().unwrap();
    fs::write(scratch.path().join("notes.txt"), "not a segment").unwrap();
    let read: Vec<_> = SpoolReader::open(scratch.path(), STREAM, None).unwrap().collect();
    let [Ok(SpoolItem::Record(record))] = &read[..] else { panic!("{read:?}") };
    assert_eq!((record.seq, &record.payload[..], record.time), (0, &b"one"[..], TIME));
    assert_eq!(record.boot, config(BUDGET_MIN).boot);
    let segment = scratch.path().join("00000000000000000000.seg");
    let bytes = fs::read(segment).unwrap();
    assert_eq!((bytes.len(), &bytes[168..]), (128 + 40 + 3, &b"one"[..]));
}

#[test]
fn links_pipes_and_files_of_others_are_refused_without_blocking() {
    let scratch = tempfile::tempdir().unwrap();
    let elsewhere = scratch.path().join("elsewhere");
    fs::write(&elsewhere, "precious").unwrap();
    let planted: [(&str, Plant); 4] = [
        ("it is a link", &|at| symlink(&elsewhere, at).unwrap()),
        ("the file has other hard links", &|at| fs::hard_link(&elsewhere, at).unwrap()),
        ("it is not a regular file", &|at| {
            mknodat(CWD, at, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
        }),
        ("it belongs to user 4711", &|at| {
            fs::write(at, "").unwrap();
            if chown(at, Some(4711), None).is_err() {
                println!("files of others: skipped, not run by root");
                fs::remove_file(at).unwrap();
                mknodat(CWD, at, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
            }
        }),
    ];
    for (number, (reason, plant)) in planted.into_iter().enumerate() {
        let folder = scratch.path().join(number.to_string());
        fs::create_dir(&folder).unwrap();
        plant(&folder.join("00000000000000000000.seg"));
        let opened = open(&folder);
        let Err(SpoolError::Read { source, .. }) = opened else { panic!("{reason}: opened") };
        let is_root = rustix::process::geteuid().is_root();
        assert!(source.to_string().ends_with(reason) || !is_root, "{source}");
        let read = SpoolReader::open(&folder, STREAM, None).unwrap().next();
        assert!(matches!(read, Some(Err(SpoolError::Read { .. }))), "{reason}: {read:?}");
    }
    assert_eq!(fs::read_to_string(&elsewhere).unwrap(), "precious");
    symlink(scratch.path().join("0"), scratch.path().join("link")).unwrap();
    let linked = scratch.path().join("link");
    assert!(matches!(open(&linked), Err(SpoolError::Folder { .. })));
    assert!(matches!(SpoolReader::open(&linked, STREAM, None), Err(SpoolError::Folder { .. })));
}
