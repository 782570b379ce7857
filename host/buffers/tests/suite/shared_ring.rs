//! A ring over shared memory, through the interface of rings, and the words that its samples take.
#![allow(unsafe_code)]

use std::ops::ControlFlow;

use gleaner_buffers::shared::{
    ControlPage, META_WORDS, PinLimits, SharedLayout, SharedReader, SharedWriter, in_process,
};
use gleaner_buffers::{Lease, RingCounts, RingReader};

const LIMITS: PinLimits = PinLimits { first_word: 0, windows: 2, window: 3, singles: 2 };

fn topic() -> (SharedWriter, SharedReader) {
    let layout = SharedLayout { depth: 4, slots: 4 + LIMITS.quota() + 1, slot_bytes: 64 };
    let (memory, reading) = in_process(layout).unwrap();
    let (mut writer, control) = (SharedWriter::new(memory), ControlPage::on_heap());
    writer.attach(control.clone(), LIMITS).unwrap();
    // SAFETY: the page is attached with these limits, and nothing else stores to it.
    let reader = unsafe { SharedReader::new(&reading, control, LIMITS) }.unwrap();
    (writer, reader)
}

/// The ring from position `first` on; its metadata is the value of the sample.
fn ring(reader: &SharedReader, first: u64, depth: usize) -> RingReader<u64> {
    let (too_big_before, words) = (reader.counters()[0], |words: &[u64; META_WORDS]| words[0]);
    RingReader::shared(reader.clone(), first, depth, words, |it| it.counters()[0], too_big_before)
}

/// Publishes samples whose bytes and metadata are the next values.
fn publish(writer: &mut SharedWriter, count: u64) {
    for _ in 0..count {
        let value = writer.head();
        writer.draft(8).unwrap().copy_from_slice(&value.to_le_bytes());
        writer.publish(&[value; META_WORDS]).unwrap();
    }
}

fn value(lease: &Lease<u64>) -> u64 {
    assert_eq!(**lease, lease.meta().to_le_bytes());
    *lease.meta()
}

/// The samples that a visit of the ring shows, newest first; it breaks after `break_at` of them.
fn seen(ring: &RingReader<u64>, end: u64, most: usize, least: u64, break_at: usize) -> Vec<u64> {
    let mut seen = Vec::new();
    ring.visit_while_before(
        end,
        most,
        |value| *value >= least,
        |position, value, bytes| {
            assert_eq!(ring.meta(position), Some(*value));
            assert_eq!(bytes, value.to_le_bytes());
            seen.push(*value);
            if seen.len() == break_at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        },
    );
    seen
}

fn values(leases: &[Lease<u64>]) -> Vec<u64> {
    leases.iter().map(value).collect()
}

#[test]
fn positions_count_from_the_first_sample_of_the_reader() {
    let (mut writer, reader) = topic();
    publish(&mut writer, 10);
    let ring = ring(&reader, 10, 3);
    assert_eq!((ring.head(), ring.depth()), (0, 3));
    assert!(ring.newest().is_none() && ring.get(0).is_none() && ring.meta(0).is_none());
    assert_eq!(ring.newest_meta(), None);
    publish(&mut writer, 2);
    let newest = ring.newest().unwrap();
    assert_eq!((value(&newest), newest.position()), (11, Some(1)));
    assert_eq!((ring.get(0).map(|it| value(&it)), ring.meta(0)), (Some(10), Some(10)));
    assert_eq!(ring.newest_meta(), Some((1, 11)));
    let mut all = Vec::new();
    ring.last(9, &mut all);
    assert_eq!(values(&all), [10, 11], "samples from before it are hidden");
    assert!(ring.get(2).is_none() && ring.get(u64::MAX).is_none());
}

#[test]
fn a_ring_shows_its_own_depth_of_a_deeper_topic() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 3);
    publish(&mut writer, 5);
    let mut all = Vec::new();
    ring.last(9, &mut all);
    assert_eq!(values(&all), [2, 3, 4]);
    assert!(ring.get(1).is_none() && ring.meta(1).is_none(), "the topic still shows it");
    ring.last_before(4, 9, &mut all);
    assert_eq!(values(&all), [2, 3]);
    ring.last_before(2, 9, &mut all);
    assert!(all.is_empty() && ring.newest_before(2).is_none());
    assert_eq!(ring.newest_before(4).map(|it| value(&it)), Some(3));
    ring.newest_while(2, |_| true, &mut all);
    assert_eq!(values(&all), [3, 4]);
    ring.newest_while(9, |value| *value > 3, &mut all);
    assert_eq!(values(&all), [4]);
    ring.newest_while(9, |value| *value < 4, &mut all);
    assert!(all.is_empty(), "the newest one is refused");
    ring.last(0, &mut all);
    assert!(all.is_empty());
}

#[test]
fn a_visit_shows_the_newest_samples_first_and_takes_no_word_afterwards() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 3);
    publish(&mut writer, 5);
    for _ in 0..9 {
        assert_eq!(seen(&ring, u64::MAX, 9, 0, 9), [4, 3, 2]);
        assert_eq!(seen(&ring, 4, 9, 0, 9), [3, 2]);
        assert_eq!(seen(&ring, u64::MAX, 2, 0, 9), [4, 3]);
        assert_eq!(seen(&ring, u64::MAX, 9, 3, 9), [4, 3]);
        assert_eq!(seen(&ring, u64::MAX, 9, 0, 1), [4]);
        assert!(seen(&ring, u64::MAX, 0, 0, 9).is_empty());
    }
    assert_eq!(ring.refused_holds(), 0);
}

#[test]
fn counts_begin_with_the_ring() {
    let (mut writer, reader) = topic();
    publish(&mut writer, 3);
    writer.set_counters(&[5; 8]);
    let ring = ring(&reader, 3, 4);
    assert_eq!(ring.counts(), RingCounts::default());
    publish(&mut writer, 6);
    writer.set_counters(&[7; 8]);
    let counts = RingCounts { received: 6, overwritten: 2, no_slot: 0, too_big: 2 };
    assert_eq!(ring.counts(), counts);
}

#[test]
fn a_lease_keeps_its_bytes_as_long_as_any_clone_lives() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 4);
    publish(&mut writer, 3);
    let mut window = Vec::new();
    ring.last(3, &mut window);
    let one = window[1].clone();
    drop((window, ring, reader));
    publish(&mut writer, 100);
    assert_eq!((value(&one), one.with_headroom()[..4].to_vec()), (1, vec![0; 4]));
}

#[test]
fn reads_of_held_samples_take_no_further_word() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 4);
    publish(&mut writer, 3);
    let mut window = Vec::new();
    ring.last(3, &mut window);
    let more: Vec<_> = (0..50).flat_map(|_| [ring.newest(), ring.get(1), ring.get(0)]).collect();
    assert_eq!((more.iter().flatten().count(), ring.refused_holds()), (150, 0));
    // The word is in use until the last of them is dropped.
    drop(window);
    publish(&mut writer, 100);
    assert!(more.iter().flatten().all(|lease| value(lease) < 3));
}

#[test]
fn reads_without_a_free_word_are_counted_and_words_return() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 4);
    let mut kept = Vec::new();
    for _ in 0..4 {
        publish(&mut writer, 1);
        kept.extend(ring.newest());
    }
    publish(&mut writer, 1);
    assert_eq!((kept.len(), ring.refused_holds()), (4, 0));
    let mut all = Vec::new();
    ring.last(1, &mut all);
    assert!(ring.newest().is_none() && ring.get(4).is_none() && all.is_empty());
    assert_eq!((ring.refused_holds(), ring.meta(4)), (3, Some(4)));
    kept.pop();
    assert_eq!((ring.newest().map(|it| value(&it)), ring.refused_holds()), (Some(4), 3));
}

#[test]
fn without_a_word_for_a_window_its_samples_take_words_for_single_ones() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 4);
    let mut kept = Vec::new();
    for _ in 0..3 {
        publish(&mut writer, 2);
        let mut window = Vec::new();
        ring.last(2, &mut window);
        kept.push(window);
    }
    assert_eq!(ring.refused_holds(), 0);
    publish(&mut writer, 100);
    assert_eq!(kept.iter().map(|it| values(it)).collect::<Vec<_>>(), [[0, 1], [2, 3], [4, 5]]);
    let mut more = Vec::new();
    ring.last(2, &mut more);
    assert_eq!((more.len(), ring.refused_holds()), (0, 1));
    kept.pop();
    ring.last(2, &mut more);
    assert_eq!(values(&more), [104, 105]);
}

#[test]
fn a_read_of_more_samples_than_a_word_can_name_takes_several_words() {
    let (mut writer, reader) = topic();
    let ring = ring(&reader, 0, 4);
    publish(&mut writer, 4);
    let mut all = Vec::new();
    ring.last(4, &mut all);
    assert_eq!((values(&all), ring.refused_holds()), (vec![0, 1, 2, 3], 0));
    let mut newer = Vec::new();
    publish(&mut writer, 2);
    ring.last(3, &mut newer);
    publish(&mut writer, 100);
    assert_eq!((values(&all), values(&newer)), (vec![0, 1, 2, 3], vec![3, 4, 5]));
    assert_eq!(ring.refused_holds(), 0, "a window and a single one, and a further window");
}

#[test]
fn a_ring_continues_in_other_memory_and_keeps_the_earlier_samples_until_newer_ones_replace_them() {
    let ((mut before, reader), (mut after, other)) = (topic(), topic());
    let ring = ring(&reader, 0, 3);
    publish(&mut before, 5);
    let held = ring.newest().unwrap();
    drop(before);
    publish(&mut after, 2);
    let all = |ring: &RingReader<u64>| {
        let mut all = Vec::new();
        ring.last(9, &mut all);
        let all: Vec<_> = all.iter().map(|it| (*it.meta(), it.position().unwrap())).collect();
        let mut seen = Vec::new();
        ring.visit_while_before(
            u64::MAX,
            9,
            |_| true,
            |position, meta, _| {
                seen.insert(0, (*meta, position));
                ControlFlow::Continue(())
            },
        );
        assert_eq!(seen, all);
        all
    };
    ring.continue_in(other, 2, 0, |words| words[0] + 1000);
    assert_eq!((ring.head(), ring.newest_meta()), (5, Some((4, 4))));
    assert_eq!(all(&ring), [(2, 2), (3, 3), (4, 4)]);
    publish(&mut after, 1);
    assert_eq!(all(&ring), [(3, 3), (4, 4), (1002, 5)]);
    assert_eq!((ring.meta(4), ring.meta(5), ring.meta(2)), (Some(4), Some(1002), None));
    assert_eq!(ring.get(3).map(|it| *it.meta()), Some(3));
    assert_eq!(ring.newest_before(5).map(|it| *it.meta()), Some(4));
    let mut some = Vec::new();
    ring.newest_while(9, |value| *value > 3, &mut some);
    assert_eq!(some.iter().map(|it| *it.meta()).collect::<Vec<_>>(), [4, 1002]);
    ring.newest_while(9, |value| *value > 1002, &mut some);
    assert!(some.is_empty());
    publish(&mut after, 2);
    ring.drop_left();
    assert_eq!(all(&ring), [(1002, 5), (1003, 6), (1004, 7)]);
    assert!(ring.get(4).is_none() && ring.meta(4).is_none());
    assert_eq!((value(&held), held.position()), (4, Some(4)), "what is held stays");
    assert_eq!(ring.counts(), RingCounts { received: 8, overwritten: 5, no_slot: 0, too_big: 0 });
}

#[test]
fn a_ring_that_continues_again_and_again_counts_on_and_keeps_what_it_shows() {
    let (_, reader) = topic();
    let ring = ring(&reader, 0, 3);
    for turn in 0..20_u64 {
        let (mut writer, reader) = topic();
        writer.set_counters(&[turn; 8]);
        ring.continue_in(reader, 0, turn, move |words| words[0] + 10 * turn);
        publish(&mut writer, turn % 2);
        writer.set_counters(&[turn + 2; 8]);
    }
    assert_eq!((ring.head(), ring.counts().too_big), (10, 40));
    let mut all = Vec::new();
    ring.last(9, &mut all);
    assert_eq!(all.iter().map(|it| *it.meta()).collect::<Vec<_>>(), [150, 170, 190]);
}
