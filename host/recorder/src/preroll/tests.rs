//! Tests of both stores.

use std::fs;

use super::*;

fn held(topic: usize, at: i64) -> EntryMeta {
    let meta = SampleMeta {
        publish_ns: at - 1,
        endian: if at % 2 == 0 { Endian::Little } else { Endian::Big },
        options: [0, at as u8],
        ..SampleMeta::new(at, Guid([topic as u8; 16]), at as u64 + 1)
    };
    EntryMeta::sample(topic, &meta, 0)
}

/// Returns distinct bytes, of a length that differs from sample to sample.
fn payload(at: i64, max_len: u64) -> Vec<u8> {
    let len = (at as u64).wrapping_mul(2_654_435_761) % (max_len + 1);
    (0..len).map(|n| (n as i64 * 7 + at) as u8).collect()
}

fn everything(preroll: &mut Preroll) -> Vec<(EntryMeta, Vec<u8>)> {
    let mut all = Vec::new();
    let mut next = preroll.next(None);
    while let Some(walked) = next {
        let place = walked.place();
        all.push((preroll.held(place), preroll.bytes(place).unwrap().to_vec()));
        next = preroll.next(next);
    }
    all
}

fn scratch(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("gleaner-preroll-{}-{name}", std::process::id()));
    let _ = fs::remove_dir_all(&path);
    path
}

/// Opens one store of each kind, for at most `bytes`.
fn stores(name: &str, bytes: u64) -> [Preroll; 2] {
    [Store::Ram, Store::Disk]
        .map(|store| Preroll::open(store, bytes, scratch(name), false).unwrap())
}

#[test]
fn entries_come_out_in_order_and_the_bound_holds() {
    for (bound, max_len) in [(4_096, 300), (1_000, 900), (100_000, 4_000), (2 << 20, 300_000)] {
        for mut preroll in stores("bound", bound) {
            let mut first = 0;
            for at in 0..3_000 {
                let bytes = payload(at, max_len);
                let taken = preroll.push(held(3, at), &bytes, &mut |gone| {
                    assert_eq!(gone.at_ns, first, "the oldest goes first");
                    first += 1;
                });
                assert_eq!((taken.unwrap(), preroll.bytes_held() <= bound), (true, true));
                if at % 97 == 0 || at > 2_990 {
                    let all = everything(&mut preroll);
                    let stamps: Vec<_> = all.iter().map(|(held, _)| held.at_ns).collect();
                    assert_eq!(stamps, (first..=at).collect::<Vec<_>>());
                    for (found, bytes) in all {
                        assert_eq!(bytes, payload(found.at_ns, max_len));
                        let len = bytes.len() as u32;
                        assert_eq!(found, EntryMeta { len, ..held(3, found.at_ns) });
                    }
                }
            }
            assert!(preroll.bytes_highest() <= bound && preroll.bytes_highest() > bound / 3);
        }
    }
}

#[test]
fn an_entry_larger_than_the_store_is_refused() {
    for mut preroll in stores("large", 1 << 10) {
        assert!(preroll.push(held(0, 1), &[1; 100], &mut |_| panic!()).unwrap());
        assert!(!preroll.push(held(0, 2), &[2; 1 << 10], &mut |_| panic!()).unwrap());
        assert_eq!(everything(&mut preroll).len(), 1);
        let mut gone = 0;
        assert!(preroll.push(held(0, 3), &[3; 952], &mut |_| gone += 1).unwrap(), "it just fits");
        assert_eq!((gone, everything(&mut preroll).len()), (1, 1));
    }
}

#[test]
fn old_entries_are_dropped_and_marks_stay() {
    for mut preroll in stores("trim", 3 << 20) {
        for at in 0..1_000 {
            preroll.push(held(1, at), &payload(at, 9_000), &mut |_| {}).unwrap();
        }
        let first = everything(&mut preroll)[0].0.at_ns;
        let mut next = preroll.next(None);
        while let Some(place) = next.map(PrerollCursor::place) {
            let at = preroll.held(place).at_ns;
            preroll.mark(place, at as u64 % 5);
            next = preroll.next(next);
        }
        let mut aged = Vec::new();
        preroll.trim(900, &mut |held| aged.push(held.at_ns)).unwrap();
        assert_eq!(aged, (first..900).collect::<Vec<_>>());
        let all = everything(&mut preroll);
        assert_eq!(all.len(), 100);
        assert!(all.iter().all(|(held, _)| held.group == held.at_ns as u64 % 5));
        preroll.trim(5_000, &mut |_| {}).unwrap();
        assert_eq!((preroll.next(None), everything(&mut preroll)), (None, Vec::new()));
        preroll.push(held(1, 6_000), b"later", &mut |_| {}).unwrap();
        assert_eq!(everything(&mut preroll)[0].1, b"later");
    }
}

#[test]
fn a_reader_continues_whatever_was_added_and_dropped_meanwhile() {
    for mut preroll in stores("walk", 4_096) {
        let (mut last, mut seen) = (None, Vec::new());
        for at in 0..2_000 {
            preroll.push(held(1, at), &payload(at, 300), &mut |_| {}).unwrap();
            // At times more entries come between two reads than the store keeps.
            if at % 5 == 0 && at % 400 < 300 {
                while let Some(walked) = preroll.next(last) {
                    seen.push(preroll.held(walked.place()).at_ns);
                    last = Some(walked);
                }
                assert_eq!(seen.last(), Some(&at));
            }
            if at % 777 == 0 {
                preroll.trim(at, &mut |_| {}).unwrap();
            }
        }
        assert!(seen.windows(2).all(|pair| pair[0] < pair[1]), "nothing twice");
        assert!(seen.len() > 1_200, "{} are too few", seen.len());
    }
}

#[test]
fn the_disk_has_only_the_needed_files_and_none_at_the_end() {
    let folder = scratch("files");
    fs::create_dir_all(&folder).unwrap();
    for name in ["7.chunk", "x.chunk", "notes.txt"] {
        fs::write(folder.join(name), "earlier").unwrap();
    }
    let names = || {
        let mut names: Vec<_> = fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    };
    let mut preroll = Preroll::open(Store::Disk, 16 << 20, folder.clone(), false).unwrap();
    // Chunks of an earlier process are deleted, other files stay.
    assert_eq!(names(), ["notes.txt", "x.chunk"]);
    for at in 0..1_000 {
        preroll.push(held(1, at), &[at as u8; 100_000], &mut |_| {}).unwrap();
        preroll.trim(at - 30, &mut |_| {}).unwrap();
    }
    let chunks = names().len() - 2;
    assert!((3..=5).contains(&chunks), "31 samples of 100 kB are in 1 MiB each: {chunks}");
    let bytes: u64 =
        names().iter().map(|name| fs::metadata(folder.join(name)).unwrap().len()).sum();
    assert!(bytes <= preroll.bytes_held());
    drop(preroll);
    assert_eq!(names(), ["notes.txt", "x.chunk"]);
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_failing_disk_is_reported_with_its_path() {
    let folder = scratch("fails");
    let mut preroll = Preroll::open(Store::Disk, 16 << 20, folder.clone(), false).unwrap();
    fs::remove_dir_all(&folder).unwrap();
    let error = preroll.push(held(0, 1), b"x", &mut |_| {}).unwrap_err();
    let RecordError::Preroll { path, .. } = &error else { panic!("{error:?}") };
    assert!(path.ends_with("0.chunk"), "{error:?}");
    fs::write(&folder, "a file").unwrap();
    let refused = Preroll::open(Store::Disk, 16 << 20, folder.clone(), false).err().unwrap();
    let RecordError::Preroll { path, .. } = &refused else { panic!("{refused:?}") };
    assert_eq!(*path, folder);
    fs::remove_file(folder).unwrap();
}

#[test]
fn on_a_full_disk_the_oldest_entries_are_dropped_without_error() {
    let folder = scratch("full");
    let mut preroll = Preroll::open(Store::Disk, 16 << 20, folder.clone(), false).unwrap();
    let mut gone = Vec::new();
    // Larger than the write buffer, and smaller.
    for bytes in [300_000, 100_000] {
        gone.clear();
        for at in 0..50 {
            preroll
                .push(held(1, at), &vec![at as u8; bytes], &mut |_| panic!("there is room"))
                .unwrap();
        }
        let number = |path: fs::DirEntry| {
            path.path().file_stem().unwrap().to_str().unwrap().parse::<u64>().unwrap()
        };
        let next =
            1 + fs::read_dir(&folder).unwrap().map(|path| number(path.unwrap())).max().unwrap();
        let full = next..next + 30;
        for number in full.clone() {
            std::os::unix::fs::symlink("/dev/full", folder.join(format!("{number}.chunk")))
                .unwrap();
        }
        let mut at = 50;
        while folder.join(format!("{}.chunk", full.end - 1)).symlink_metadata().is_ok() {
            let mut note = |held: &EntryMeta| gone.push(held.at_ns);
            preroll.push(held(1, at), &vec![at as u8; bytes], &mut note).unwrap();
            at += 1;
        }
        // There is room again.
        let last = at + 5;
        for at in at..=last {
            let mut note = |held: &EntryMeta| gone.push(held.at_ns);
            preroll.push(held(1, at), &vec![at as u8; bytes], &mut note).unwrap();
        }
        let all = everything(&mut preroll);
        let is_right = |(held, bytes): &(EntryMeta, Vec<u8>)| {
            bytes.iter().all(|byte| *byte == held.at_ns as u8)
        };
        assert!(all.len() >= 5 && all.iter().all(is_right));
        let stamps = gone.iter().copied().chain(all.iter().map(|(held, _)| held.at_ns));
        assert!(stamps.eq(0..=last), "each is kept or was reported");
        preroll.trim(last + 1, &mut |_| {}).unwrap();
    }
}

#[test]
fn a_preroll_on_a_nearly_full_disk_shrinks() {
    let folder = scratch("shrink");
    let mut preroll = Preroll::open(Store::Disk, 16 << 20, folder.clone(), false).unwrap();
    let files = || fs::read_dir(&folder).unwrap().count();
    let push = |preroll: &mut Preroll, stamps: std::ops::Range<i64>| {
        for at in stamps {
            preroll.push(held(1, at), &[at as u8; 100_000], &mut |_| {}).unwrap();
        }
    };
    push(&mut preroll, 0..100);
    let before = files();
    preroll.shrink(true);
    push(&mut preroll, 100..130);
    let less = files();
    assert!(less < before, "{before} files, then {less}");
    push(&mut preroll, 130..500);
    assert_eq!(files(), 1);
    assert_eq!(everything(&mut preroll).last().unwrap().0.at_ns, 499);
    preroll.shrink(false);
    push(&mut preroll, 500..600);
    assert!(files() >= before);
}
