//! Tests rings through the public interface, one thread at a time.

use gleaner_buffers::{
    DraftError, HeapRegion, Lease, Pool, PoolError, RingCounts, RingReader, RingWriter, ring,
};

fn pool(slots: usize) -> Pool<u64> {
    let bytes = Pool::<u64>::bytes_needed(slots, 8).unwrap();
    Pool::new(HeapRegion::zeroed(bytes).unwrap(), slots, 8).unwrap()
}

/// Creates a ring whose samples contain their position, as bytes and as metadata.
fn ring_of(slots: usize, depth: usize) -> (RingWriter<u64>, RingReader<u64>) {
    ring(pool(slots), depth).unwrap()
}

fn publish(writer: &mut RingWriter<u64>, value: u64) -> u64 {
    let mut draft = writer.draft(8).unwrap();
    draft.copy_from_slice(&value.to_le_bytes());
    writer.publish(draft, value).unwrap()
}

fn value(lease: &Lease<u64>) -> u64 {
    let value = u64::from_le_bytes((**lease).try_into().unwrap());
    assert_eq!(*lease.meta(), value);
    value
}

fn last(reader: &RingReader<u64>, n: usize) -> Vec<u64> {
    let mut out = Vec::new();
    reader.last(n, &mut out);
    out.iter().map(value).collect()
}

#[test]
fn a_new_ring_is_empty() {
    let (_writer, reader) = ring_of(2, 2);
    assert_eq!((reader.head(), reader.depth()), (0, 2));
    assert!(reader.newest().is_none() && reader.get(0).is_none());
    assert!(last(&reader, 2).is_empty());
    assert_eq!(reader.counts(), RingCounts::default());
}

#[test]
fn positions_count_up_from_zero_and_name_the_sample() {
    let (mut writer, reader) = ring_of(4, 3);
    for position in 0..3 {
        assert_eq!(publish(&mut writer, 10 + position), position);
    }
    assert_eq!(reader.head(), 3);
    for position in 0..3 {
        let lease = reader.get(position).unwrap();
        assert_eq!(lease.position(), Some(position));
        assert_eq!(value(&lease), 10 + position);
    }
    for position in [3, 4, u64::MAX] {
        assert!(reader.get(position).is_none(), "{position} is not published");
    }
}

#[test]
fn a_full_ring_drops_its_oldest_sample() {
    let (mut writer, reader) = ring_of(4, 3);
    for sample in 0..5 {
        publish(&mut writer, sample);
    }
    assert_eq!(last(&reader, 9), [2, 3, 4]);
    assert!(reader.get(1).is_none());
    let counts = reader.counts();
    assert_eq!((counts.received, counts.overwritten), (5, 2));
}

#[test]
fn the_last_n_are_oldest_first_and_replace_the_content_of_the_vec() {
    let (mut writer, reader) = ring_of(5, 4);
    for sample in 0..6 {
        publish(&mut writer, sample);
    }
    assert_eq!(last(&reader, 0), [0; 0]);
    assert_eq!(last(&reader, 1), [5]);
    assert_eq!(last(&reader, 3), [3, 4, 5]);
    let mut out = vec![reader.get(2).unwrap()];
    reader.last(2, &mut out);
    assert_eq!(out.iter().map(value).collect::<Vec<_>>(), [4, 5]);
    reader.last(0, &mut out);
    assert!(out.is_empty());
}

#[test]
fn newest_while_stops_at_the_first_sample_refused() {
    let (mut writer, reader) = ring_of(6, 5);
    for sample in [3, 9, 1, 4, 5] {
        publish(&mut writer, sample);
    }
    let mut out = Vec::new();
    let mut asked = Vec::new();
    let keep = |&meta: &u64| {
        asked.push(meta);
        meta >= 3
    };
    reader.newest_while(9, keep, &mut out);
    assert_eq!(out.iter().map(value).collect::<Vec<_>>(), [4, 5]);
    assert_eq!(asked, [5, 4, 1]);
    reader.newest_while(1, |_| true, &mut out);
    assert_eq!(out.iter().map(value).collect::<Vec<_>>(), [5]);
    reader.newest_while(9, |_| false, &mut out);
    assert!(out.is_empty());
}

#[test]
fn a_pinned_sample_stays_readable_after_it_has_left_the_ring() {
    let pool = pool(4);
    let (mut writer, reader) = ring(pool.clone(), 2).unwrap();
    publish(&mut writer, 0);
    let pinned = reader.get(0).unwrap();
    for sample in 1..9 {
        publish(&mut writer, sample);
    }
    assert!(reader.get(0).is_none());
    assert_eq!((value(&pinned), pinned.position()), (0, Some(0)));
    assert_eq!(last(&reader, 2), [7, 8]);
    assert_eq!(pool.free(), 1);
    drop(pinned);
    assert_eq!(pool.free(), 2);
}

#[test]
fn without_a_free_slot_the_oldest_unpinned_sample_is_evicted() {
    let (mut writer, reader) = ring_of(3, 3);
    for sample in 0..3 {
        publish(&mut writer, sample);
    }
    let pinned = reader.get(0).unwrap();
    publish(&mut writer, 3);
    assert!(reader.get(1).is_none());
    // 0 has left because three newer ones were published, 1 because its slot was needed; each is
    // counted once.
    assert_eq!(last(&reader, 3), [2, 3]);
    assert_eq!(reader.counts().overwritten, 2);
    assert_eq!(value(&pinned), 0);
}

#[test]
fn an_evicted_newest_sample_makes_the_one_before_it_the_newest() {
    let (mut writer, reader) = ring_of(2, 2);
    publish(&mut writer, 0);
    publish(&mut writer, 1);
    let pinned = reader.get(0).unwrap();
    let draft = writer.draft(8).unwrap();
    assert_eq!(value(&reader.newest().unwrap()), 0);
    assert_eq!(last(&reader, 2), [0]);
    drop((draft, pinned));
    assert_eq!(reader.counts().overwritten, 1);
    assert_eq!(reader.head(), 2);
}

#[test]
fn when_every_sample_is_pinned_a_draft_is_refused_and_counted() {
    let (mut writer, reader) = ring_of(2, 2);
    publish(&mut writer, 0);
    publish(&mut writer, 1);
    let mut pinned = Vec::new();
    reader.last(2, &mut pinned);
    assert_eq!(writer.draft(8).unwrap_err(), DraftError::NoSlot);
    assert_eq!(writer.draft(8).unwrap_err(), DraftError::NoSlot);
    assert_eq!(reader.counts().no_slot, 2);
    assert_eq!(reader.counts().overwritten, 0);
    pinned.remove(0);
    assert_eq!(publish(&mut writer, 2), 2);
    assert_eq!(last(&reader, 2), [1, 2]);
}

#[test]
fn a_sample_too_big_is_refused_and_counted_and_evicts_nothing() {
    let (mut writer, reader) = ring_of(1, 1);
    publish(&mut writer, 0);
    let error = DraftError::TooBig { len: 9, max: 8 };
    assert_eq!(writer.draft(9).unwrap_err(), error);
    assert_eq!(last(&reader, 1), [0]);
    let expected = RingCounts { received: 1, too_big: 1, ..RingCounts::default() };
    assert_eq!(reader.counts(), expected);
}

#[test]
fn a_ring_evicts_only_its_own_samples() {
    let pool = pool(2);
    let (mut full, full_reader) = ring(pool.clone(), 2).unwrap();
    let (mut other, other_reader) = ring(pool, 1).unwrap();
    publish(&mut full, 0);
    publish(&mut full, 1);
    assert_eq!(other.draft(8).unwrap_err(), DraftError::NoSlot);
    assert_eq!(last(&full_reader, 2), [0, 1]);
    assert_eq!(other_reader.counts().no_slot, 1);
}

#[test]
fn a_draft_of_another_pool_is_returned_and_not_published() {
    let pool_a = pool(2);
    let (mut writer, reader) = ring(pool_a.clone(), 1).unwrap();
    assert_eq!(writer.publish(pool_a.draft(0).unwrap(), 0).unwrap(), 0);
    let pool_b = pool(1);
    let foreign = writer.publish(pool_b.draft(3).unwrap(), 1).unwrap_err();
    assert_eq!(foreign.0.len(), 3);
    assert_eq!(reader.head(), 1);
    drop(foreign);
    assert_eq!(pool_b.free(), 1);
}

#[test]
fn samples_outlive_the_writer_and_leases_outlive_ring_and_pool() {
    let pool = pool(3);
    let (mut writer, reader) = ring(pool.clone(), 2).unwrap();
    publish(&mut writer, 0);
    publish(&mut writer, 1);
    drop(writer);
    let lease = reader.newest().unwrap();
    assert_eq!(last(&reader, 2), [0, 1]);
    drop(reader);
    assert_eq!(pool.free(), 2, "a dropped ring holds nothing");
    drop(pool);
    assert_eq!(value(&lease), 1);
}

#[test]
fn a_depth_of_zero_or_beyond_the_pool_is_refused() {
    for depth in [0, 3, usize::MAX] {
        let error = ring(pool(2), depth).unwrap_err();
        assert_eq!(error, PoolError::Depth { depth, slots: 2 });
    }
}

#[test]
fn a_reader_can_be_limited_to_samples_before_a_position() {
    let (mut writer, reader) = ring_of(6, 4);
    for sample in 0..5 {
        publish(&mut writer, sample);
    }
    let before = |end: u64, n: usize| {
        let mut out = Vec::new();
        reader.last_before(end, n, &mut out);
        out.iter().map(value).collect::<Vec<_>>()
    };
    assert_eq!(before(4, 9), [1, 2, 3]);
    assert_eq!(before(4, 2), [2, 3]);
    assert_eq!(before(9, 2), [3, 4]);
    assert_eq!(reader.newest_before(4).as_ref().map(value), Some(3));
    // A sample that has left the ring does not come back.
    assert!(
        before(1, 9).is_empty()
            && reader.newest_before(1).is_none()
            && reader.newest_before(0).is_none()
    );
}
