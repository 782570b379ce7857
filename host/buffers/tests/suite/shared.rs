//! A topic in shared memory: what readers see, what they may hold, and what hostile ones cannot do.
#![allow(unsafe_code)]

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use gleaner_buffers::shared::{
    ControlMemory, ControlPage, HAZARDS, HeldSample, META_WORDS, PinLimits, ReadError, ReaderId,
    SharedLayout, SharedReader, SharedWriter, WriteError, in_process,
};

/// Words of a control page that a hostile reader overwrites: more than it is granted.
const GARBAGE_WORDS: usize = 16;

/// Returns a writer with readers: windows, positions of a window, and single positions of each.
fn topic<const N: usize>(
    (depth, slots, slot_bytes): (u32, u32, u64),
    readers: [(u16, u16, u16); N],
) -> (SharedWriter, [(SharedReader, Arc<ControlPage>, ReaderId); N]) {
    let (memory, reading) = in_process(SharedLayout { depth, slots, slot_bytes }).unwrap();
    let mut writer = SharedWriter::new(memory);
    let attach = |(windows, window, singles)| {
        let control = ControlPage::on_heap();
        let limits = PinLimits { first_word: 0, windows, window, singles };
        let id = writer.attach(control.clone(), limits).unwrap();
        // SAFETY: the page is attached with these limits, and the tests store to pages of readers
        // only that hold nothing.
        let reader = unsafe { SharedReader::new(&reading, control.clone(), limits) }.unwrap();
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
    let (mut writer, [(reader, ..)]) = topic((4, 16, 256), [(1, 4, 3)]);
    assert!(reader.newest_before(u64::MAX).unwrap().is_none());
    for _ in 0..6 {
        publish(&mut writer);
    }
    assert_eq!(reader.newest_before(u64::MAX).unwrap().unwrap().position(), 5);
    assert_eq!(reader.newest_before(4).unwrap().unwrap().position(), 3);
    assert!(reader.newest_before(2).unwrap().is_none(), "0 and 1 have left");
    assert_eq!(positions(&reader.last_before(u64::MAX, 3).unwrap().unwrap()), [3, 4, 5]);
    assert_eq!(positions(&reader.last_before(4, 9).unwrap().unwrap()), [2, 3]);
    assert!(writer.shown(1).is_none() && writer.shown(6).is_none());
    assert_eq!(
        writer.shown(2).unwrap(),
        (&*reader.get(2).unwrap().unwrap(), [2, 80, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2])
    );
    writer.set_counters(&[1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(reader.counters(), [1, 2, 3, 4, 5, 6, 7, 8]);
    assert!(reader.get(1).unwrap().is_none() && reader.get(6).unwrap().is_none());
}

#[test]
fn a_held_sample_stays_until_its_last_handle_is_dropped() {
    let (mut writer, [(reader, ..)]) = topic((2, 6, 256), [(1, 2, 1)]);
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
fn further_slots_are_used_only_while_samples_are_held() {
    let (memory, reading) =
        in_process(SharedLayout { depth: 2, slots: 32, slot_bytes: 256 }).unwrap();
    let mut writer = SharedWriter::with_warm_slots(memory, 6);
    let control = ControlPage::on_heap();
    let limits = PinLimits { first_word: 0, windows: 0, window: 0, singles: 9 };
    writer.attach(control.clone(), limits).unwrap();
    // SAFETY: the page is attached with these limits, and nothing else stores to it.
    let reader = unsafe { SharedReader::new(&reading, control, limits) }.unwrap();
    let mut used = std::collections::BTreeSet::new();
    let mut publish_some = |writer: &mut SharedWriter, samples: usize| {
        let publish_one = |_| {
            publish(writer);
            let newest = reader.newest_before(u64::MAX).unwrap().unwrap();
            used.insert(newest.as_ptr() as usize);
            newest
        };
        let newest: Vec<HeldSample> = (0..samples).map(publish_one).collect();
        (used.len(), newest)
    };
    for _ in 0..100 {
        publish_some(&mut writer, 1);
    }
    assert_eq!(publish_some(&mut writer, 1).0, 6);
    let held = publish_some(&mut writer, 8).1;
    for _ in 0..100 {
        publish_some(&mut writer, 1);
    }
    let most = publish_some(&mut writer, 1).0;
    assert_eq!(most, 8 + 6, "held and warm");
    drop(held);
    for _ in 0..100 {
        assert_eq!(publish_some(&mut writer, 1).0, most, "those are used again");
    }
}

/// A page that counts how often it is looked at.
struct CountedPage(Arc<ControlPage>, Arc<AtomicU64>);

// SAFETY: as for the page in it.
unsafe impl ControlMemory for CountedPage {
    fn page(&self) -> NonNull<ControlPage> {
        self.1.fetch_add(1, Ordering::Relaxed);
        self.0.page()
    }
}

#[test]
fn a_reader_that_slides_its_windows_does_not_make_each_draft_look_at_them() {
    let (depth, warm, window) = (8, 16, 32);
    let (memory, _) =
        in_process(SharedLayout { depth, slots: warm + 2 * window, slot_bytes: 256 }).unwrap();
    let mut writer = SharedWriter::with_warm_slots(memory, warm);
    let (control, looks) = (ControlPage::on_heap(), Arc::new(AtomicU64::new(0)));
    let limits = PinLimits { first_word: 0, windows: 2, window: window as u16, singles: 0 };
    writer.attach(CountedPage(control.clone(), looks.clone()), limits).unwrap();
    // With so many positions behind the shown ones under hazards, it tries each way to leave one
    // slot for the next draft.
    for held in (0..=u64::from(2 * window)).step_by(if cfg!(miri) { 16 } else { 1 }) {
        looks.store(0, Ordering::Relaxed);
        for _ in 0..200 {
            let first = writer.head().saturating_sub(u64::from(depth) + held);
            for word in 0..2 {
                let first = first + u64::from(window) * word as u64;
                // SAFETY: this reader holds nothing.
                unsafe { control.overwrite(word, first << 16 | u64::from(window)) };
            }
            publish(&mut writer);
        }
        let looks = looks.load(Ordering::Relaxed);
        assert!(looks <= 200 / u64::from(warm - depth) + 1, "{looks} looks, {held} held");
    }
}

#[test]
fn a_reader_that_holds_its_quota_gets_no_more_and_stops_nobody() {
    let (mut writer, [(reader, ..)]) = topic((2, 6, 256), [(1, 2, 0)]);
    publish(&mut writer);
    publish(&mut writer);
    let window = reader.window(0, 2).unwrap().unwrap();
    assert!(reader.get(1).unwrap().is_some(), "the window holds it");
    publish(&mut writer);
    assert_eq!(reader.get(2).err(), Some(ReadError::OutOfHolds));
    for _ in 0..100 {
        publish(&mut writer);
    }
    assert_eq!(positions(&window), [0, 1]);
    drop(window);
    assert!(reader.newest_before(u64::MAX).unwrap().is_some());
}

#[test]
fn quotas_beyond_the_slots_are_refused() {
    let (mut writer, [(_, _, id)]) = topic((2, 6, 256), [(1, 2, 0)]);
    let control = ControlPage::on_heap();
    let limits = |first_word, singles| PinLimits { first_word, windows: 0, window: 0, singles };
    let refused = writer.attach(control.clone(), limits(0, 2)).unwrap_err();
    assert_eq!(refused, WriteError::Quota { asked: 2, left: 1 });
    for limits in [limits(0, 0), limits(HAZARDS as u32, 1), limits(u32::MAX, u16::MAX)] {
        assert_eq!(writer.attach(control.clone(), limits).unwrap_err(), WriteError::Hazards);
    }
    writer.detach(id);
    writer.attach(control, limits(0, 3)).unwrap();
}

#[test]
fn layouts_that_no_region_can_have_are_refused() {
    let layout = SharedLayout { depth: 1, slots: 3, slot_bytes: 100 };
    assert!(layout.bytes_needed().is_some());
    assert_eq!(Some(layout.bytes_of_first(3)), layout.bytes_needed());
    assert_eq!(Some(layout.bytes_of_first(u32::MAX)), layout.bytes_needed());
    assert!(layout.bytes_of_first(2) < layout.bytes_of_first(3));
    for impossible in [
        SharedLayout { depth: 0, ..layout },
        SharedLayout { slots: 1, ..layout },
        SharedLayout { slots: u32::MAX, ..layout },
        SharedLayout { slot_bytes: 1 << 32, ..layout },
        SharedLayout { slot_bytes: u64::MAX, ..layout },
    ] {
        assert_eq!(impossible.bytes_needed(), None, "{impossible:?}");
    }
}

#[test]
fn positions_beyond_the_last_are_not_shown() {
    let (mut writer, [(reader, ..)]) = topic((2, 6, 256), [(1, 2, 1)]);
    publish(&mut writer);
    assert!(reader.get(u64::MAX).unwrap().is_none());
    assert!(reader.window(u64::MAX, 2).unwrap().is_none());
}

/// The sum of the positions that words name, each read once, may exceed what the reader ever held.
#[test]
fn a_steady_hold_stays_while_other_words_move() {
    let samples = if cfg!(miri) { 30 } else { 200_000 };
    let (mut writer, [(reader, ..)]) = topic((3, 12, 256), [(1, 2, 3)]);
    publish(&mut writer);
    let done = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                let steady = reader.newest_before(u64::MAX).unwrap().unwrap();
                for _ in 0..8 {
                    drop(reader.last_before(u64::MAX, 2).unwrap());
                    let one = reader.newest_before(u64::MAX).unwrap();
                    let two = reader.newest_before(u64::MAX).unwrap();
                    assert!(is_whole(&steady), "torn");
                    drop((one, two));
                }
            }
        });
        for _ in 0..samples {
            publish(&mut writer);
        }
        done.store(true, Ordering::Relaxed);
    });
}

#[test]
fn a_sample_larger_than_a_slot_is_refused() {
    let (mut writer, []) = topic((1, 3, 100), []);
    let refused = writer.draft(101).err();
    assert_eq!(refused, Some(WriteError::TooBig { len: 101, max: 100 }));
    writer.draft(100).unwrap().fill(7);
    assert_eq!(writer.drafted(), Some(&[7; 100][..]));
    writer.discard();
    assert_eq!(writer.drafted(), None);
    assert_eq!(writer.publish(&[0; META_WORDS]), None);
    for _ in 0..100 {
        writer.draft(100).unwrap();
        writer.draft(100).unwrap().truncate(8);
        writer.publish(&[0; META_WORDS]).unwrap();
    }
}

/// Writes garbage over the hazard words of a control page.
fn garbage(control: &impl ControlMemory, state: &mut u64) {
    for word in 0..GARBAGE_WORDS {
        *state ^= *state << 13;
        *state ^= *state >> 7;
        *state ^= *state << 17;
        // SAFETY: this reader holds nothing.
        unsafe { control.overwrite(word, *state) };
    }
}

#[test]
fn hostile_readers_neither_tear_samples_of_others_nor_stop_the_writer() {
    let long = std::env::var_os("GLEANER_LONG").is_some();
    let samples = if cfg!(miri) { 30 } else { 300_000 * if long { 20 } else { 1 } };
    let (mut writer, [honest, other, words, word, follower]) =
        topic((8, 64, 256), [(3, 4, 1), (3, 4, 1), (0, 0, 8), (1, 8, 0), (2, 4, 0)]);
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
                // SAFETY: this reader holds nothing.
                unsafe {
                    control.overwrite(0, head.saturating_sub(3) << 16 | 0xffff);
                    control.overwrite(1, head << 16 | 0xffff);
                }
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
