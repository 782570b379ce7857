//! Orders of a writer and readers in one process.

use gleaner_buffers::{HeapRegion, Lease, Pool, RingReader, RingWriter, ring};
use loom::thread;

fn pool(slots: usize) -> Pool<u64> {
    let bytes = Pool::<u64>::bytes_needed(slots, 8).unwrap();
    Pool::new(HeapRegion::zeroed(bytes).unwrap(), slots, 8).unwrap()
}

/// Publishes `value` as bytes and as metadata; returns false if there was no slot.
fn publish(writer: &mut RingWriter<u64>, value: u64) -> bool {
    let Ok(mut draft) = writer.draft(8) else {
        return false;
    };
    draft.copy_from_slice(&value.to_le_bytes());
    writer.publish(draft, value).unwrap();
    true
}

/// Reads a sample twice, with steps in between at which other threads may run.
fn value(lease: &Lease<u64>) -> u64 {
    let value = *lease.meta();
    assert_eq!(**lease, value.to_le_bytes());
    let clone = lease.clone();
    assert_eq!(**lease, value.to_le_bytes());
    assert_eq!(*clone.meta(), value);
    value
}

fn last(reader: &RingReader<u64>, n: usize) -> Vec<u64> {
    let mut out = Vec::new();
    reader.last(n, &mut out);
    out.iter().map(value).collect()
}

#[test]
fn newest_never_misses_while_samples_are_published() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(3), 1).unwrap();
        publish(&mut writer, 0);
        let reading = thread::spawn(move || {
            let first = *reader.newest().unwrap().meta();
            let second = value(&reader.newest().unwrap());
            assert!(first <= second);
            reader
        });
        assert!(publish(&mut writer, 1));
        assert!(publish(&mut writer, 2));
        let reader = reading.join().unwrap();
        assert_eq!(value(&reader.newest().unwrap()), 2);
    });
}

#[test]
fn newest_never_misses_although_its_place_holds_a_slot_used_for_the_first_time() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(3), 1).unwrap();
        publish(&mut writer, 0);
        // A pinned slot is not reused: 2 goes to the place of 0, but to a slot that no reader has
        // seen.
        let pinned = reader.get(0).unwrap();
        let reading = thread::spawn(move || drop(reader.newest().unwrap()));
        assert!(publish(&mut writer, 1));
        assert!(publish(&mut writer, 2));
        reading.join().unwrap();
        assert_eq!(value(&pinned), 0);
    });
}

#[test]
fn a_position_below_head_can_be_read() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(3), 2).unwrap();
        let reading = thread::spawn(move || {
            if let Some(position) = reader.head().checked_sub(1) {
                assert_eq!(value(&reader.get(position).unwrap()), position);
            }
            let seen = last(&reader, 2);
            assert!([&[][..], &[0], &[0, 1]].contains(&&*seen), "{seen:?}");
        });
        assert!(publish(&mut writer, 0));
        assert!(publish(&mut writer, 1));
        reading.join().unwrap();
    });
}

#[test]
fn a_sample_is_either_pinned_or_evicted() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(1), 1).unwrap();
        publish(&mut writer, 0);
        let reading = thread::spawn(move || {
            let seen = reader.get(0).map(|lease| value(&lease));
            assert!(seen.is_none_or(|value| value == 0));
            reader
        });
        let published = publish(&mut writer, 1);
        let reader = reading.join().unwrap();
        let counts = reader.counts();
        assert_eq!(counts.overwritten, u64::from(published));
        assert_eq!(counts.no_slot, u64::from(!published));
        assert_eq!(value(&reader.newest().unwrap()), u64::from(published));
    });
}

#[test]
fn evicting_a_sample_does_not_hide_a_newer_one() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(3), 3).unwrap();
        publish(&mut writer, 0);
        publish(&mut writer, 1);
        let pinned = reader.get(0).unwrap();
        let reading = thread::spawn(move || {
            let newest = value(&reader.newest().unwrap());
            assert!(newest > 0, "0 was not the newest at any moment");
        });
        publish(&mut writer, 2);
        // Takes the slot of 1, since 0 is pinned; or that of 2, while the reader looks at 1.
        drop(writer.draft(8).unwrap());
        reading.join().unwrap();
        assert_eq!(value(&pinned), 0);
    });
}

#[test]
fn a_slot_is_released_once_and_has_one_draft() {
    fn draft_one(pool: &Pool<u64>, value: u64) {
        let Ok(mut draft) = pool.draft(8) else { return };
        draft.copy_from_slice(&value.to_le_bytes());
        assert_eq!(self::value(&draft.seal(value)), value);
    }
    loom::model(|| {
        let pool = pool(2);
        let lease = pool.draft(8).unwrap().seal(0);
        let clone = lease.clone();
        let releasing = thread::spawn({
            let pool = pool.clone();
            move || {
                assert_eq!(*clone.meta(), 0);
                drop(clone);
                draft_one(&pool, 1);
            }
        });
        assert_eq!(*lease.meta(), 0);
        drop(lease);
        draft_one(&pool, 2);
        releasing.join().unwrap();
        assert_eq!(pool.free(), 2);
    });
}

#[test]
fn a_reader_never_returns_a_sample_of_another_ring() {
    loom::model(|| {
        let pool = pool(1);
        let (mut first, reader) = ring(pool.clone(), 1).unwrap();
        let (mut second, _) = ring(pool, 1).unwrap();
        publish(&mut first, 7);
        let reading = thread::spawn(move || {
            let seen = reader.get(0).map(|lease| value(&lease));
            assert!(seen.is_none_or(|value| value == 7));
        });
        // Evicts the sample of this ring at position 0, frees the slot, and publishes in it at
        // position 0 of the other ring.
        drop(first.draft(8));
        publish(&mut second, 8);
        reading.join().unwrap();
    });
}

#[test]
fn a_reader_never_returns_a_later_sample_than_requested() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(2), 1).unwrap();
        publish(&mut writer, 0);
        let reading = thread::spawn(move || {
            let seen = reader.get(0).map(|lease| value(&lease));
            assert!(seen.is_none_or(|value| value == 0));
        });
        for position in 1..4 {
            publish(&mut writer, position);
        }
        reading.join().unwrap();
    });
}

#[test]
fn overwritten_never_exceeds_received() {
    loom::model(|| {
        let (mut writer, reader) = ring(pool(2), 1).unwrap();
        let reading = thread::spawn(move || {
            let counts = reader.counts();
            assert!(counts.overwritten <= counts.received);
        });
        assert!(publish(&mut writer, 0));
        assert!(publish(&mut writer, 1));
        reading.join().unwrap();
    });
}
