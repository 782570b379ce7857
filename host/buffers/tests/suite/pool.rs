//! Tests pools, drafts and leases through the public interface.

use gleaner_buffers::{
    Draft, DraftError, HeapRegion, Lease, Pool, PoolError, RingReader, RingWriter,
};

fn pool(slots: usize, slot_bytes: usize) -> Pool<u32> {
    let bytes = Pool::<u32>::bytes_needed(slots, slot_bytes).unwrap();
    Pool::new(HeapRegion::zeroed(bytes).unwrap(), slots, slot_bytes).unwrap()
}

fn sealed(pool: &Pool<u32>, bytes: &[u8], meta: u32) -> Lease<u32> {
    let mut draft = pool.draft(bytes.len()).unwrap();
    draft.copy_from_slice(bytes);
    draft.seal(meta)
}

#[test]
fn a_draft_has_the_requested_length_and_can_be_truncated() {
    let pool = pool(1, 8);
    let mut draft = pool.draft(8).unwrap();
    draft.copy_from_slice(b"12345678");
    draft.truncate(3);
    draft.truncate(5);
    assert_eq!(*draft.seal(0), *b"123");
    assert_eq!(pool.draft(0).unwrap().len(), 0);
}

#[test]
fn a_dropped_draft_frees_its_slot() {
    let pool = pool(1, 8);
    let draft = pool.draft(1).unwrap();
    assert_eq!(pool.free(), 0);
    assert_eq!(pool.draft(1).unwrap_err(), DraftError::NoSlot);
    drop(draft);
    assert_eq!(pool.free(), 1);
    assert!(pool.draft(1).is_ok());
}

#[test]
fn the_last_lease_frees_the_slot() {
    let pool = pool(2, 8);
    let first = sealed(&pool, b"abc", 7);
    let second = first.clone();
    drop(first);
    assert_eq!(pool.free(), 1);
    assert_eq!((&*second, *second.meta()), (&b"abc"[..], 7));
    drop(second);
    assert_eq!(pool.free(), 2);
}

#[test]
fn a_lease_outlives_its_pool() {
    let lease = sealed(&pool(1, 8), b"abc", 7);
    assert_eq!((&*lease, *lease.meta()), (&b"abc"[..], 7));
    assert_eq!(lease.position(), None);
}

#[test]
fn a_sample_larger_than_a_slot_is_refused_with_both_sizes() {
    let error = pool(1, 8).draft(9).unwrap_err();
    assert_eq!(error, DraftError::TooBig { len: 9, max: 8 });
    assert_eq!(error.to_string(), "sample of 9 bytes; a slot holds 8 bytes");
}

#[test]
fn headroom_and_sample_are_one_slice_and_headroom_starts_at_zero() {
    let pool = pool(1, 8);
    let mut draft = pool.draft(2).unwrap();
    *draft.headroom_mut() = [0, 1, 0, 0];
    draft.copy_from_slice(b"ab");
    assert_eq!(*draft.seal(0).with_headroom(), *b"\x00\x01\x00\x00ab");
    assert_eq!(*pool.draft(2).unwrap().headroom_mut(), [0; 4]);
}

#[test]
fn full_slots_and_headrooms_do_not_overlap() {
    for slot_bytes in [0, 1, 60, 61, 64, 200] {
        let pool = pool(5, slot_bytes);
        let leases: Vec<_> = (0..5)
            .map(|fill| {
                let mut draft = pool.draft(slot_bytes).unwrap();
                assert_eq!(draft.as_ptr() as usize % 64, 0);
                draft.headroom_mut().fill(fill);
                draft.fill(fill);
                draft.seal(0)
            })
            .collect();
        for (fill, lease) in (0..).zip(&leases) {
            assert_eq!(lease.with_headroom(), vec![fill; 4 + slot_bytes]);
        }
    }
}

#[test]
fn a_region_one_byte_short_is_refused_with_both_sizes() {
    let needed = Pool::<()>::bytes_needed(3, 100).unwrap();
    // A cache line for the first headroom, and 104 bytes rounded up to two lines for each slot.
    assert_eq!(needed, 64 + 3 * 128);
    let region = HeapRegion::zeroed(needed - 1).unwrap();
    let error = Pool::<()>::new(region, 3, 100).unwrap_err();
    let given = needed - 1;
    assert_eq!(error, PoolError::RegionTooSmall { needed, given });
    assert_eq!(error.to_string(), "pool needs a region of 448 bytes; it was given 447 bytes");
}

#[test]
fn sizes_that_overflow_are_refused() {
    let most = usize::MAX;
    for (slots, slot_bytes) in [(1, most), (1, most - 3), (1, most / 2), (1 << 30, most >> 30)] {
        let region = HeapRegion::zeroed(64).unwrap();
        let error = Pool::<()>::new(region, slots, slot_bytes).unwrap_err();
        assert_eq!(error, PoolError::TooLarge { slots, slot_bytes });
        assert_eq!(Pool::<()>::bytes_needed(slots, slot_bytes), None);
    }
}

#[test]
fn a_pool_of_no_slots_or_too_many_is_refused() {
    for slots in [0, 1 << 31, usize::MAX] {
        let region = HeapRegion::zeroed(64).unwrap();
        let error = Pool::<()>::new(region, slots, 1).unwrap_err();
        assert_eq!(error, PoolError::SlotCount { slots });
    }
}

#[test]
fn every_handle_can_be_sent_and_shared() {
    fn check<T: Send + Sync>() {}
    check::<Pool<u32>>();
    check::<Draft<u32>>();
    check::<Lease<u32>>();
    check::<RingWriter<u32>>();
    check::<RingReader<u32>>();
}
