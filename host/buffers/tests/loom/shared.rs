//! Orders of a writer and readers in shared memory.
#![allow(unsafe_code)]

use std::time::Duration;

use gleaner_buffers::shared::{
    ControlPage, Futex, HeldSample, META_WORDS, Notifier, PinLimits, SharedLayout, SharedReader,
    SharedWriter, fences, in_process,
};
use loom::sync::Arc;
use loom::sync::atomic::{AtomicU32, Ordering};
use loom::thread;

fn topic(depth: u32, slots: u32, windows: u16, singles: u16) -> (SharedWriter, SharedReader) {
    warm_topic(depth, slots, 0, (windows, singles))
}

fn warm_topic(
    depth: u32,
    slots: u32,
    warm: u32,
    (windows, singles): (u16, u16),
) -> (SharedWriter, SharedReader) {
    let (memory, reading) = in_process(SharedLayout { depth, slots, slot_bytes: 8 }).unwrap();
    let control = ControlPage::on_heap();
    let mut writer = SharedWriter::with_warm_slots(memory, warm);
    let limits = PinLimits { first_word: 0, windows, window: 2, singles };
    writer.attach(control.clone(), limits).unwrap();
    // SAFETY: the page is attached with these limits, and nothing else stores to it.
    (writer, unsafe { SharedReader::new(&reading, control, limits) }.unwrap())
}

fn publish(writer: &mut SharedWriter, value: u64) {
    let mut draft = writer.draft(8).unwrap();
    draft.copy_from_slice(&value.to_le_bytes());
    let mut meta = [0; META_WORDS];
    meta[0] = value;
    writer.publish(&meta).unwrap();
}

fn check(hold: &HeldSample) {
    assert_eq!(**hold, hold.position().to_le_bytes());
    assert_eq!(hold.meta()[0], hold.position());
}

/// Held by each model: one of them leaves out a fence for all threads of the process.
static MODEL: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Waits until no other model runs.
fn alone() -> std::sync::MutexGuard<'static, ()> {
    MODEL.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Publishes values up to `before`, and then those up to `all` while another thread reads.
fn beside(
    (mut writer, reader): (SharedWriter, SharedReader),
    before: u64,
    all: u64,
    read: fn(&SharedReader),
) {
    (0..before).for_each(|value| publish(&mut writer, value));
    let reading = thread::spawn(move || read(&reader));
    (before..all).for_each(|value| publish(&mut writer, value));
    reading.join().unwrap();
}

/// One sample under a hazard, while the writer takes slots.
fn one() {
    loom::model(|| {
        beside(topic(1, 3, 0, 1), 1, 4, |reader| {
            if let Some(hold) = reader.get(0).unwrap() {
                check(&hold);
                check(&hold);
            }
            if let Some(hold) = reader.get(1).unwrap() {
                check(&hold);
            }
        });
    });
}

#[test]
fn a_held_sample_does_not_change() {
    let _alone = alone();
    one();
}

/// Slots that one look at the hazards frees are used by later drafts, without another look.
#[test]
fn a_sample_in_a_slot_that_was_freed_before_does_not_change() {
    let _alone = alone();
    loom::model(|| {
        // The first frees three slots, the last two of them again.
        beside(warm_topic(1, 5, 4, (0, 1)), 4, 8, |reader| {
            if let Some(hold) = reader.get(3).unwrap() {
                check(&hold);
            }
            if let Some(hold) = reader.get(4).unwrap() {
                check(&hold);
            }
        });
    });
}

#[test]
fn a_held_window_does_not_change() {
    let _alone = alone();
    loom::model(|| {
        beside(topic(2, 5, 1, 0), 2, 6, |reader| {
            if let Some(window) = reader.window(0, 2).unwrap() {
                window.iter().for_each(check);
            }
        });
    });
}

#[test]
fn a_held_sample_stays_while_other_words_move() {
    let _alone = alone();
    loom::model(|| {
        let (mut writer, reader) = topic(3, 8, 1, 2);
        for value in 0..3 {
            publish(&mut writer, value);
        }
        let steady = reader.get(0).unwrap().unwrap();
        let window = reader.window(1, 2).unwrap().unwrap();
        // All slots are used, and 0 to 4 have left.
        for value in 3..8 {
            publish(&mut writer, value);
        }
        let reading = thread::spawn(move || {
            drop(window);
            let one = reader.get(6).unwrap();
            check(&steady);
            drop(one);
            check(&steady);
        });
        publish(&mut writer, 8);
        reading.join().unwrap();
    });
}

#[test]
fn meta_data_without_a_hold_is_that_of_its_position() {
    let _alone = alone();
    loom::model(|| {
        beside(topic(1, 3, 0, 1), 1, 4, |reader| {
            for position in 0..2 {
                assert!(reader.meta(position).is_none_or(|meta| meta[0] == position));
            }
        });
    });
}

#[test]
fn a_shared_hold_protects_until_both_threads_are_done() {
    let _alone = alone();
    loom::model(|| {
        let (mut writer, reader) = topic(1, 3, 0, 1);
        publish(&mut writer, 0);
        let other = reader.clone();
        let reading = thread::spawn(move || {
            if let Some(hold) = other.get(0).unwrap() {
                check(&hold);
            }
        });
        // The one word of both threads.
        if let Some(hold) = reader.get(0).unwrap() {
            publish(&mut writer, 1);
            publish(&mut writer, 2);
            check(&hold);
        }
        publish(&mut writer, 3);
        reading.join().unwrap();
    });
}

#[test]
fn the_newest_sample_is_never_missing() {
    let _alone = alone();
    loom::model(|| {
        beside(topic(1, 3, 0, 1), 1, 3, |reader| {
            assert!(reader.newest_before(u64::MAX).unwrap().is_some());
        });
    });
}

#[test]
fn the_newest_window_is_never_missing() {
    let _alone = alone();
    loom::model(|| {
        beside(topic(2, 5, 1, 0), 2, 3, |reader| {
            assert!(reader.last_before(u64::MAX, 2).unwrap().is_some());
        });
    });
}

/// Runs `model` without a fence, and expects that it fails.
fn fails(without: &std::sync::atomic::AtomicBool, model: fn()) {
    let _alone = alone();
    without.store(true, std::sync::atomic::Ordering::Relaxed);
    let found = std::panic::catch_unwind(model);
    without.store(false, std::sync::atomic::Ordering::Relaxed);
    assert!(found.is_err(), "the model does not see the missing fence");
}

#[test]
fn without_the_readers_fence_the_model_finds_a_torn_sample() {
    fails(&fences::NO_READER_FENCE, one);
}

#[test]
fn without_the_writers_fence_the_model_finds_a_torn_sample() {
    fails(&fences::NO_WRITER_FENCE, one);
}

/// A futex as the kernel has it, which compares and sleeps under one lock.
struct Sleeper {
    state: loom::sync::Mutex<Sleep>,
    change: loom::sync::Condvar,
}

#[derive(Default)]
struct Sleep {
    sleeps: bool,
    woken: bool,
    /// The ring is over: the timeout of the sleep.
    over: bool,
}

struct Kernel(Arc<Sleeper>);

impl Futex for Kernel {
    fn wait(&self, word: &AtomicU32, seen: u32, _: Duration) {
        let mut state = self.0.state.lock().unwrap();
        if word.load(Ordering::Relaxed) != seen {
            return;
        }
        state.sleeps = true;
        while !state.woken && !state.over {
            state = self.0.change.wait(state).unwrap();
        }
        assert!(state.woken, "the reader sleeps beside a sample");
    }

    fn wake(&self, _: &AtomicU32) {
        let mut state = self.0.state.lock().unwrap();
        state.woken = state.sleeps;
        self.0.change.notify_all();
    }
}

#[test]
fn no_ring_is_missed() {
    let _alone = alone();
    rings();
}

/// A ring between the reader's look at its topics and its sleep.
fn rings() {
    loom::model(|| {
        let control = ControlPage::on_heap();
        let state = loom::sync::Mutex::new(Sleep::default());
        let sleeper = Arc::new(Sleeper { state, change: loom::sync::Condvar::new() });
        let published = Arc::new(AtomicU32::new(0));
        let bell = Notifier::of(control.clone());
        let (seen_by_reader, kernel) = (published.clone(), Kernel(sleeper.clone()));
        let waiting = thread::spawn(move || {
            let mut bell = Notifier::of(control);
            let seen = bell.value();
            if seen_by_reader.load(Ordering::Acquire) == 0 {
                bell.wait(seen, Duration::from_secs(1), &kernel);
            }
        });
        published.store(1, Ordering::Release);
        bell.ring(&Kernel(sleeper.clone()));
        sleeper.state.lock().unwrap().over = true;
        sleeper.change.notify_all();
        waiting.join().unwrap();
    });
}

#[test]
fn without_the_bells_fences_the_model_finds_a_missed_ring() {
    fails(&fences::NO_BELL_FENCE, rings);
}
