//! Tests packed files and messages that are damaged or too large.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, SystemTime};

use gleaner_drives::{Damage, DriveLimits, DriveOptions, Replay, ReplayError, Unpacked, unpack};
use gleaner_messages::transport::{Delivery, SampleMeta, Sink, TopicSpec, Transport};

use super::bag::{Packing, Storage, bag, cdr, folder, mcap_of, packed, unpack_in};
use super::hostile::{damage, refused};
use crate::support::{
    MemorySink, TOPICS, begun, drive, expected, file, listen, run, run_whole, small_chunks, spec,
    ticking,
};

/// Takes messages up to a size, and notes the largest one offered.
struct LimitedSink {
    most: usize,
    shown: AtomicUsize,
}

impl Sink for LimitedSink {
    fn deliver(&self, _: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.shown.fetch_max(cdr.len(), Ordering::Relaxed);
        if cdr.len() > self.most { Delivery::TooBig } else { Delivery::Taken }
    }
}

#[test]
fn a_message_that_unpacks_to_too_much_is_too_big_but_the_next_is_not() {
    let messages = ticking(&["/a"], 3, 10);
    let bytes = mcap_of(&messages, |message| match message.value {
        1 => packed(&[&[0, 1, 0, 0][..], &vec![0; 100 << 20]].concat()),
        _ => packed(&cdr(message)),
    });
    assert!(bytes.len() < 100_000, "{}", bytes.len());
    let path = file(&bytes);
    let open = |limits| Replay::open_with(std::slice::from_ref(&path), limits).unwrap();
    let mut replay = open(DriveLimits::default());
    let sink = Arc::new(LimitedSink { most: 1000, shown: AtomicUsize::new(0) });
    let small = TopicSpec { max_bytes: 1000, ..spec("/a") };
    replay.subscribe(&small, sink.clone()).unwrap();
    let steps = run_whole(&mut replay);
    let deliveries: Vec<_> = steps.iter().map(|step| step.delivery).collect();
    assert_eq!(deliveries, [Delivery::Taken, Delivery::TooBig, Delivery::Taken]);
    assert_eq!(sink.shown.load(Ordering::Relaxed), 8);
    // A sink without a limit gets an error at the limit of the drive.
    let mut replay = open(DriveLimits { chunk_bytes: 1 << 20, ..DriveLimits::default() });
    let endless = TopicSpec { max_bytes: usize::MAX, ..spec("/a") };
    replay.subscribe(&endless, Arc::new(MemorySink::default())).unwrap();
    let (steps, error) = run(&mut replay);
    assert_eq!(steps.len(), 1);
    assert!(matches!(damage(error).1, Damage::MessageTooLarge { allowed: 1_048_576, .. }));
}

#[test]
fn a_packed_message_is_delivered_whole_or_is_too_big() {
    let messages = ticking(&["/a"], 3, 10);
    let large = [&[0, 1, 0, 0][..], &vec![7; 5000]].concat();
    let path = file(&mcap_of(&messages, |message| match message.value {
        1 => packed(&large),
        _ => packed(&cdr(message)),
    }));
    for (limits, lens) in [
        (&[1000][..], &[8, 8][..]),
        (&[4999], &[8, 8]),
        (&[5000], &[8, 5000, 8]),
        (&[1000, 2000], &[8, 8, 8, 8]),
        (&[1000, 1 << 30, 2000], &[8, 8, 8, 5000, 8, 8, 8]),
    ] {
        let mut replay = Replay::open(std::slice::from_ref(&path)).unwrap();
        let memory = Arc::new(MemorySink::default());
        for &max_bytes in limits {
            replay.subscribe(&TopicSpec { max_bytes, ..spec("/a") }, memory.clone()).unwrap();
        }
        let steps = run_whole(&mut replay);
        let taken: Vec<_> = memory.0.lock().unwrap().iter().map(|(_, cdr)| cdr.len()).collect();
        assert_eq!(taken, lens, "{limits:?}");
        let too_big = steps.iter().filter(|step| step.delivery == Delivery::TooBig).count();
        assert_eq!(too_big, 3 * limits.len() - lens.len(), "{limits:?}");
    }
}

/// Incompressible bytes.
fn noise(len: u32) -> Vec<u8> {
    let mut state = 1_u32;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as u8
    };
    (0..len).map(|_| next()).collect()
}

#[test]
fn a_file_that_unpacks_to_too_much_is_refused_and_leaves_nothing() {
    let folder = folder();
    let small = drive(small_chunks(), &ticking(&["/a"], 3, 10));
    let limits = DriveLimits { unpacked_bytes: 1 << 20, ..DriveLimits::default() };
    let options = DriveOptions { limits, ..unpack_in(folder.path()) };
    let open = |paths: &[PathBuf]| Replay::open_as(paths, &options).map(drop);
    let error = open(&[file(&packed(&[&small[..], &noise(2 << 20)].concat()))]).unwrap_err();
    assert!(matches!(error, ReplayError::UnpacksTooLarge { allowed: 1_048_576, .. }), "{error}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    // The limit holds for all files together.
    let part = [&small[..], &noise(700 << 10)].concat();
    let parts = [file(&packed(&part)), file(&packed(&part))];
    open(&parts[..1]).unwrap();
    let error = open(&parts).unwrap_err();
    let ReplayError::UnpacksTooLarge { path, .. } = &error else { panic!("{error}") };
    assert_eq!(*path, parts[1]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn a_bomb_is_refused_by_its_size_long_before_the_disk_is_full() {
    let folder = folder();
    let bomb = packed(
        &[&drive(small_chunks(), &ticking(&["/a"], 3, 10))[..], &vec![0; 64 << 20]].concat(),
    );
    let limits = DriveLimits { unpacked_bytes: 64 << 20, ..DriveLimits::default() };
    let options = DriveOptions { limits, ..unpack_in(folder.path()) };
    let error = Replay::open_as(&[file(&bomb)], &options).err().unwrap();
    let ReplayError::UnpacksManyTimes { allowed, .. } = &error else { panic!("{error}") };
    assert_eq!(*allowed, (200 * bomb.len() as u64).max(1 << 20));
    assert!(error.help().unwrap().contains("zstd -d"), "{error}");
}

#[test]
fn unpacked_content_has_no_name() {
    let folder = folder();
    let messages = ticking(&TOPICS, 60, 1000);
    for storage in [Storage::Mcap, Storage::Sqlite3] {
        let bag = bag(storage, Packing::Files, &[&messages]);
        let unpacked = unpack(&[bag.path().to_owned()], &unpack_in(folder.path())).unwrap();
        assert_eq!(unpacked.len(), 1);
        // A kill from here on leaves no file.
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "{storage:?}");
    }
}

#[test]
fn content_unpacked_by_another_process_is_read_without_write_access() {
    let messages = ticking(&TOPICS, 60, 1000);
    let bag = bag(Storage::Mcap, Packing::Files, &[&messages]);
    let paths = [bag.path().to_owned()];
    let unpacked = unpack(&paths, &DriveOptions::default()).unwrap();
    let names: Vec<_> =
        unpacked.iter().map(|one| one.name(&DriveOptions::default()).unwrap()).collect();
    let handed = unpacked.iter().zip(&names).map(|(one, name)| {
        let (path, broken) = one.parts();
        Unpacked::named(path.to_owned(), name.as_ref().to_owned(), broken.map(str::to_owned))
            .unwrap()
    });
    let nowhere = Some(bag.path().join("nowhere"));
    let options =
        DriveOptions { unpack_in: nowhere, unpacked: handed.collect(), ..DriveOptions::default() };
    // Both replays read the same file.
    let mut replays = [0; 2].map(|_| Replay::open_as(&paths, &options).unwrap());
    let memories = replays.each_mut().map(|replay| listen(replay, &TOPICS));
    for _ in 0..30 {
        for replay in &mut replays {
            replay.step().unwrap();
        }
    }
    for (mut replay, memory) in replays.into_iter().zip(memories) {
        assert!(run(&mut replay).1.is_none());
        assert_eq!(memory.values(), expected(&messages));
    }
}

#[test]
fn only_files_of_killed_processes_are_removed() {
    let folder = folder();
    let packed = file(&packed(&drive(small_chunks(), &ticking(&["/a"], 3, 10))));
    let old = SystemTime::now() - Duration::from_secs(7200);
    let path = |name: &str| folder.path().join(name);
    for (name, at) in [
        (".unpacked-old", Some(old)),
        (".unpacked-new", None),
        (".unpacked-twice", Some(old)),
        ("unpacked-old", Some(old)),
        ("drive.mcap", Some(old)),
    ] {
        let left = fs::File::create(path(name)).unwrap();
        at.map_or(Ok(()), |at| left.set_modified(at)).unwrap();
    }
    fs::hard_link(path(".unpacked-twice"), path("second")).unwrap();
    fs::create_dir(path(".unpacked-folder")).unwrap();
    std::os::unix::fs::symlink(path("drive.mcap"), path(".unpacked-link")).unwrap();
    Replay::open_as(&[packed], &unpack_in(folder.path())).unwrap();
    let mut left: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    let others = [".unpacked-folder", ".unpacked-link", ".unpacked-new", ".unpacked-twice"];
    assert_eq!(left, [&others[..], &["drive.mcap", "second", "unpacked-old"]].concat());
}

#[test]
fn content_of_an_unknown_format_is_not_unpacked() {
    let folder = folder();
    let nowhere = folder.path().join("not there");
    let path = file(&packed(&vec![7; 8 << 20]));
    let error = Replay::open_as(&[path], &unpack_in(&nowhere)).err().unwrap();
    assert!(matches!(error, ReplayError::NotMcap { .. }), "{error}");
}

#[test]
fn a_truncated_packed_file_delivers_the_messages_before_the_cut() {
    let messages = ticking(&TOPICS, 3000, 1000);
    for storage in [Storage::Mcap, Storage::Sqlite3] {
        let bag = bag(storage, Packing::Files, &[&messages]);
        let name = if storage == Storage::Mcap { "bag_0.mcap.zstd" } else { "bag_0.db3.zstd" };
        let path = bag.path().join(name);
        let mut plain = zstd::decode_all(&fs::read(&path).unwrap()[..]).unwrap();
        // Noise after it, so that zstd ends a block before the cut.
        plain.extend((0..1_000_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8));
        let bytes = packed(&plain);
        fs::write(&path, &bytes[..bytes.len() - 10]).unwrap();
        let (mut replay, memory) = begun(std::slice::from_ref(&path), &TOPICS);
        let (_, error) = run(&mut replay);
        damage(error);
        assert_eq!(memory.values(), expected(&messages), "{storage:?}");
    }
}

#[test]
fn files_packed_twice_or_of_an_unknown_format_are_refused() {
    let bytes = drive(small_chunks(), &ticking(&["/a"], 3, 10));
    assert!(matches!(refused(&file(&packed(&packed(&bytes)))), ReplayError::NotMcap { .. }));
    assert!(matches!(refused(&file(&packed(b"notes"))), ReplayError::NotMcap { .. }));
    assert!(matches!(refused(&file(&packed(&bytes)[..6])), ReplayError::Unpack { .. }));
}
