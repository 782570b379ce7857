//! Folders on the real disk: one writer, and nothing but plain files of its user.

use std::fs;
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::path::Path;

use gleaner_base::Explain;
use gleaner_spool::{BUDGET_MIN, SpoolError, SpoolItem, SpoolReader, SpoolWriter};
use rustix::fs::{CWD, FileType, FlockOperation, Mode, flock, mknodat};

use crate::model::{KIND, STREAM, TIME, config, write};

/// Puts something at the path of a segment.
type Plant<'a> = &'a dyn Fn(&Path);

fn open(path: &Path) -> Result<SpoolWriter, SpoolError> {
    SpoolWriter::open(path, config(BUDGET_MIN))
}

/// Returns the writer of a stream with one record.
fn written(path: &Path) -> SpoolWriter {
    let mut writer = open(path).unwrap();
    write(&mut writer, b"one");
    writer
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
    let _writer = written(scratch.path());
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
    for linked in ["link", "link/", "link//", "link/."].map(|name| scratch.path().join(name)) {
        assert!(matches!(open(&linked), Err(SpoolError::Folder { .. })));
        let read = SpoolReader::open(&linked, STREAM, None);
        assert!(matches!(read, Err(SpoolError::Folder { .. })));
    }
}

#[test]
fn a_writer_whose_folder_is_removed_acknowledges_nothing() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("logs");
    let mut writer = written(&path);
    fs::remove_dir_all(&path).unwrap();
    // Another writer begins the stream again.
    let mut other = open(&path).unwrap();
    write(&mut other, b"other");
    writer.append(KIND, TIME, b"two").unwrap();
    assert!(matches!(writer.commit(), Err(SpoolError::Write { .. })));
    assert_eq!(writer.durable(), 1);
    assert_eq!(payloads(&path), [b"other"]);
}

#[test]
fn a_writer_whose_files_are_removed_begins_a_segment_or_reports_the_lost_lock() {
    let scratch = tempfile::tempdir().unwrap();
    let mut writer = written(scratch.path());
    fs::remove_file(scratch.path().join("00000000000000000000.seg")).unwrap();
    assert_eq!(write(&mut writer, b"two"), 2);
    assert_eq!(payloads(scratch.path()), [b"two"]);
    // Without the lock, another writer may have the stream.
    fs::remove_file(scratch.path().join("writer.lock")).unwrap();
    fs::remove_file(scratch.path().join("00000000000000000001.seg")).unwrap();
    writer.append(KIND, TIME, b"three").unwrap();
    let help = writer.commit().unwrap_err().help().unwrap();
    assert!(help.starts_with("start the writer again"), "{help}");
}

#[test]
fn a_writer_and_a_reader_stay_with_a_folder_that_is_renamed() {
    let scratch = tempfile::tempdir().unwrap();
    let (path, renamed) = (scratch.path().join("logs"), scratch.path().join("renamed"));
    let mut writer = open(&path).unwrap();
    let mut reader = SpoolReader::open(&path, STREAM, None).unwrap();
    fs::rename(&path, &renamed).unwrap();
    drop(open(&path).unwrap());
    assert_eq!(write(&mut writer, b"one"), 1);
    assert!(matches!(reader.next(), Some(Ok(SpoolItem::Record(_)))));
    assert_eq!((payloads(&renamed).len(), payloads(&path).len()), (1, 0));
    assert!(matches!(open(&renamed), Err(SpoolError::Busy { .. })));
}

#[test]
fn other_users_can_neither_read_nor_lock_a_stream() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("streams/logs");
    let writer = written(&path);
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&path), 0o700);
    for entry in fs::read_dir(&path).unwrap() {
        assert_eq!(mode(&entry.unwrap().path()), 0o600);
    }
    drop(writer);
    // A folder that exists may be readable, so a lock on the folder itself is not the writer's.
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    let neighbour = fs::File::open(&path).unwrap();
    flock(&neighbour, FlockOperation::LockExclusive).unwrap();
    open(&path).unwrap();
}

#[test]
fn a_lock_that_is_a_link_is_refused() {
    let scratch = tempfile::tempdir().unwrap();
    symlink(scratch.path().join("elsewhere"), scratch.path().join("writer.lock")).unwrap();
    assert!(matches!(open(scratch.path()), Err(SpoolError::Folder { .. })));
    assert!(!scratch.path().join("elsewhere").exists());
}

fn payloads(path: &Path) -> Vec<Vec<u8>> {
    let payload = |item| match item {
        Ok(SpoolItem::Record(record)) => Some(record.payload),
        _ => None,
    };
    SpoolReader::open(path, STREAM, None).unwrap().filter_map(payload).collect()
}
