//! Tests rings on real threads: readers see whole samples, in order, and all are counted. Bounded
//! by counts, not by time.

use std::{
    ops::ControlFlow,
    sync::atomic::{AtomicUsize, Ordering},
    thread,
};

use gleaner_buffers::{DraftError, HeapRegion, Lease, Pool, RingReader, RingWriter, ring};

const SAMPLES: u64 = if cfg!(miri) { 60 } else { 100_000 };
const SLOT_BYTES: usize = 96;

/// Expected content of a sample: its ring, and its position in it.
#[derive(Clone, Copy)]
struct Meta {
    ring: u64,
    position: u64,
}

impl Meta {
    fn len(self) -> usize {
        1 + (self.position as usize * 7 + self.ring as usize) % SLOT_BYTES
    }

    fn fill(self) -> u8 {
        (self.position * 2 + self.ring) as u8
    }
}

fn check(lease: &Lease<Meta>, ring: u64) -> u64 {
    check_bytes(lease.position(), lease.meta(), lease, ring)
}

fn check_bytes(position: Option<u64>, meta: &Meta, bytes: &[u8], ring: u64) -> u64 {
    assert_eq!(meta.ring, ring);
    assert_eq!(position, Some(meta.position));
    assert_eq!(bytes.len(), meta.len());
    assert!(bytes.iter().all(|&byte| byte == meta.fill()));
    meta.position
}

/// Checks the newest samples without leases, back to one whose position is a multiple of 5.
fn visit(reader: &RingReader<Meta>, ring: u64) {
    let mut last = u64::MAX;
    let is_wanted = |meta: &Meta| !meta.position.is_multiple_of(5);
    reader.visit_while_before(u64::MAX, 3, is_wanted, |position, meta, bytes| {
        assert!(check_bytes(Some(position), meta, bytes, ring) < last, "newest first");
        last = position;
        ControlFlow::Continue(())
    });
}

fn write_all(mut writer: RingWriter<Meta>, ring: u64) -> u64 {
    let mut refused = 0;
    let mut position = 0;
    for _ in 0..SAMPLES {
        let meta = Meta { ring, position };
        match writer.draft(meta.len()) {
            Ok(mut draft) => {
                draft.fill(meta.fill());
                assert_eq!(writer.publish(draft, meta).unwrap(), position);
                position += 1;
            }
            Err(DraftError::NoSlot) => refused += 1,
            Err(error) => panic!("{error}"),
        }
    }
    refused
}

/// Reads until `writers` is 0, holding up to three samples; `turn` makes readers differ.
fn read_all(reader: &RingReader<Meta>, ring: u64, turn: u64, writers: &AtomicUsize) {
    let mut held: Vec<Lease<Meta>> = Vec::new();
    let mut batch = Vec::new();
    let mut newest = 0;
    for round in turn.. {
        let finished = writers.load(Ordering::Acquire) == 0;
        visit(reader, ring);
        match round % 3 {
            0 => batch.clear(),
            1 => reader.last(3, &mut batch),
            _ => reader.newest_while(3, |meta| meta.position % 5 != 0, &mut batch),
        }
        let positions: Vec<u64> = batch.iter().map(|lease| check(lease, ring)).collect();
        assert!(positions.is_sorted_by(|older, newer| older < newer));
        if let Some(lease) = reader.newest() {
            let position = check(&lease, ring);
            assert!(position < reader.head());
            newest = newest.max(position);
            held.push(lease);
        }
        if let Some(lease) = reader.get(newest.saturating_sub(round % 6)) {
            check(&lease, ring);
        }
        held.iter().for_each(|lease| {
            check(lease, ring);
        });
        if held.len() > 2 {
            held.remove((round % 3) as usize);
        }
        let counts = reader.counts();
        assert!(counts.overwritten <= counts.received);
        if finished {
            break;
        }
    }
}

/// Runs two rings on one pool, with two readers each.
fn stress(slots: usize, depth: usize) {
    let bytes = Pool::<Meta>::bytes_needed(slots, SLOT_BYTES).unwrap();
    let region = HeapRegion::zeroed(bytes).unwrap();
    let pool = Pool::new(region, slots, SLOT_BYTES).unwrap();
    let rings = [0, 1].map(|id| (id, ring(pool.clone(), depth).unwrap()));
    let writers = AtomicUsize::new(rings.len());
    thread::scope(|scope| {
        for (id, (writer, reader)) in rings {
            let writers = &writers;
            for turn in [0, 1] {
                let reader = reader.clone();
                scope.spawn(move || read_all(&reader, id, turn, writers));
            }
            scope.spawn(move || {
                let refused = write_all(writer, id);
                writers.fetch_sub(1, Ordering::Release);
                let counts = reader.counts();
                assert_eq!(counts.no_slot, refused);
                assert_eq!(counts.received, SAMPLES - refused);
                assert!(counts.received - counts.overwritten <= depth as u64);
            });
        }
    });
    assert_eq!(pool.free(), slots);
}

#[test]
fn readers_see_whole_samples_in_order_when_slots_are_plenty() {
    stress(80, 8);
}

#[test]
fn readers_see_whole_samples_in_order_when_slots_are_scarce() {
    stress(6, 4);
}

#[test]
fn a_ring_with_enough_slots_is_never_empty_and_refuses_no_draft() {
    // Depth, one draft, and one pin for each reader.
    let slots = 1 + 1 + 2;
    let bytes = Pool::<u64>::bytes_needed(slots, 8).unwrap();
    let pool = Pool::new(HeapRegion::zeroed(bytes).unwrap(), slots, 8).unwrap();
    let (mut writer, reader) = ring(pool, 1).unwrap();
    let mut publish = |position: u64| {
        let mut draft = writer.draft(8).unwrap();
        draft.copy_from_slice(&position.to_le_bytes());
        writer.publish(draft, position).unwrap();
    };
    publish(0);
    thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                let mut newest = 0;
                while newest < SAMPLES {
                    let lease = reader.newest().unwrap();
                    assert_eq!(*lease, lease.meta().to_le_bytes());
                    assert!(newest <= *lease.meta());
                    newest = *lease.meta();
                }
            });
        }
        (1..=SAMPLES).for_each(&mut publish);
    });
    assert_eq!(reader.counts().no_slot, 0);
}
