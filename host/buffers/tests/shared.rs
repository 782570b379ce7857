#![cfg(not(loom))]
//! A topic in shared memory: what readers see, what they may hold, and what hostile ones cannot do.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use gleaner_buffers::shared::{
    ControlMemory, ControlPage, HAZARDS, HeldSample, META_WORDS, ReadError, ReaderId, SharedLayout,
    SharedMemory, SharedReader, SharedWriter, WriteError,
};

/// Returns a writer with readers, each with so many hazard words and so large a quota.
fn topic<const N: usize>(
    (depth, slots, slot_bytes): (u32, u32, u64),
    readers: [(u16, u32); N],
) -> (SharedWriter, [(SharedReader, Arc<ControlPage>, ReaderId); N]) {
    let layout = SharedLayout { depth, slots, slot_bytes };
    let (memory, reading) = SharedMemory::in_process(layout).unwrap();
    let mut writer = SharedWriter::new(memory);
    let reading = Arc::new(reading);
    let attach = |(words, quota)| {
        let control = Arc::new(ControlPage::new());
        let id = writer.attach(control.clone(), 0..words, quota).unwrap();
        let reader = SharedReader::new(reading.clone(), control.clone(), 0..words, quota).unwrap();
        (reader, control, id)
    };
    let readers = readers.map(attach);
    (writer, readers)
}

/// Publishes a sample each word of which is its position.
fn publish(writer: &mut SharedWriter) -> u64 {
    let position = writer.head();
    let len = 64 + (position % 7) as usize * 8;
    let mut draft = writer.draft(len).unwrap();
    draft.chunks_exact_mut(8).for_each(|word| word.copy_from_slice(&position.to_le_bytes()));
    let mut meta = [position; META_WORDS];
    meta[1] = len as u64;
    assert_eq!(writer.publish(&meta), Some(position));
    position
}

fn is_whole(hold: &HeldSample) -> bool {
    let position = hold.position();
    hold.len() as u64 == hold.meta()[1]
        && hold.meta()[0] == position
        && hold.chunks_exact(8).all(|word| word == position.to_le_bytes())
}

fn positions(window: &[HeldSample]) -> Vec<u64> {
    assert!(window.iter().all(is_whole));
    window.iter().map(HeldSample::position).collect()
}

#[test]
fn readers_see_the_newest_samples() {
    let (mut writer, [(reader, ..)]) = topic((4, 16, 256), [(4, 8)]);
    assert!(reader.newest_before(u64::MAX).unwrap().is_none());
    for _ in 0..6 {
        publish(&mut writer);
    }
    assert_eq!(reader.newest_before(u64::MAX).unwrap().unwrap().position(), 5);
    assert_eq!(reader.newest_before(4).unwrap().unwrap().position(), 3);
    assert!(reader.newest_before(2).unwrap().is_none(), "0 and 1 have left");
    assert_eq!(positions(&reader.last_before(u64::MAX, 3).unwrap().unwrap()), [3, 4, 5]);
    assert_eq!(positions(&reader.last_before(4, 9).unwrap().unwrap()), [2, 3]);
    assert!(reader.get(1).unwrap().is_none() && reader.get(6).unwrap().is_none());
}

#[test]
fn a_held_sample_stays_until_its_last_handle_is_dropped() {
    let (mut writer, [(reader, ..)]) = topic((2, 6, 256), [(2, 3)]);
    publish(&mut writer);
    let held = reader.get(0).unwrap().unwrap();
    let again = held.clone();
    drop(held);
    for _ in 0..1000 {
        publish(&mut writer);
        assert!(is_whole(&again));
    }
    let bytes = again.with_headroom().as_ptr();
    drop(again);
    let later = (0..10).any(|_| {
        let position = publish(&mut writer);
        reader.get(position).unwrap().unwrap().with_headroom().as_ptr() == bytes
    });
    assert!(later, "the slot is used again");
}

#[test]
fn a_reader_that_holds_its_quota_gets_no_more_and_stops_nobody() {
    let (mut writer, [(reader, ..)]) = topic((2, 6, 256), [(4, 2)]);
    publish(&mut writer);
    publish(&mut writer);
    let window = reader.window(0, 2).unwrap().unwrap();
    assert_eq!(reader.get(1).err(), Some(ReadError::OutOfHolds));
    for _ in 0..100 {
        publish(&mut writer);
    }
    assert_eq!(positions(&window), [0, 1]);
    drop(window);
    assert!(reader.newest_before(u64::MAX).unwrap().is_some());
}

#[test]
fn quotas_beyond_the_slots_are_refused() {
    let (mut writer, [(_, _, id)]) = topic((2, 6, 256), [(1, 2)]);
    let control = Arc::new(ControlPage::new());
    let refused = writer.attach(control.clone(), 0..1, 2).unwrap_err();
    assert_eq!(refused, WriteError::Quota { asked: 2, left: 1 });
    assert_eq!(writer.attach(control.clone(), 0..9999, 1).unwrap_err(), WriteError::Hazards);
    writer.detach(id);
    writer.attach(control, 0..1, 3).unwrap();
}

#[test]
fn a_sample_larger_than_a_slot_is_refused() {
    let (mut writer, []) = topic((1, 3, 100), []);
    let refused = writer.draft(101).err();
    assert_eq!(refused, Some(WriteError::TooBig { len: 101, max: 100 }));
    writer.draft(100).unwrap();
    writer.discard();
    assert_eq!(writer.publish(&[0; META_WORDS]), None);
    for _ in 0..100 {
        writer.draft(100).unwrap();
        writer.draft(100).unwrap().truncate(8);
        writer.publish(&[0; META_WORDS]).unwrap();
    }
}

/// Writes garbage over the hazard words of a control page.
fn garbage(control: &impl ControlMemory, state: &mut u64) {
    for word in 0..HAZARDS {
        *state ^= *state << 13;
        *state ^= *state >> 7;
        *state ^= *state << 17;
        control.overwrite(word, *state);
    }
}

#[test]
fn hostile_readers_neither_tear_samples_of_others_nor_stop_the_writer() {
    let long = std::env::var_os("GLEANER_LONG").is_some();
    let samples = if cfg!(miri) { 30 } else { 300_000 * if long { 20 } else { 1 } };
    let (mut writer, [honest, other, words, word, follower]) =
        topic((8, 64, 256), [(8, 12), (8, 12), (400, 8), (1, 8), (2, 8)]);
    let stop = AtomicBool::new(false);
    let verified = AtomicU64::new(0);
    thread::scope(|scope| {
        for (reader, ..) in [&honest, &other] {
            let (stop, verified) = (&stop, &verified);
            scope.spawn(move || {
                let mut kept: Vec<HeldSample> = Vec::new();
                while !stop.load(Ordering::Relaxed) {
                    if let Some(window) = reader.last_before(u64::MAX, 4).unwrap() {
                        assert!(window.iter().all(is_whole), "torn");
                        verified.fetch_add(window.len() as u64, Ordering::Relaxed);
                        if kept.len() < 2 {
                            kept.extend(window.into_samples().pop());
                        }
                    }
                    if let Some(newest) = reader.newest_before(u64::MAX).unwrap() {
                        assert!(is_whole(&newest), "torn");
                    }
                    if kept.len() == 2 {
                        assert!(kept.iter().all(is_whole), "torn while held");
                        kept.clear();
                    }
                    thread::yield_now();
                }
            });
        }
        for (seed, (_, control, _)) in (1..).zip([&words, &word]) {
            let stop = &stop;
            scope.spawn(move || {
                let mut state = 0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(seed);
                while !stop.load(Ordering::Relaxed) {
                    garbage(control, &mut state);
                    thread::yield_now();
                }
            });
        }
        // Names the newest positions, and far too many of them.
        let (reader, control, _) = &follower;
        let stop_it = &stop;
        scope.spawn(move || {
            while !stop_it.load(Ordering::Relaxed) {
                let head = reader.head();
                control.overwrite(0, head.saturating_sub(3) << 16 | 0xffff);
                control.overwrite(1, head << 16 | 0xffff);
                thread::yield_now();
            }
        });
        for _ in 0..samples {
            publish(&mut writer);
        }
        while verified.load(Ordering::Relaxed) == 0 && !cfg!(miri) {
            thread::yield_now();
        }
        stop.store(true, Ordering::Relaxed);
    });
    assert_eq!(writer.head(), samples);
    println!("{} samples verified", verified.load(Ordering::Relaxed));
}
