//! The disk of a vehicle is full, and everything is killed and started again while it is.

use super::*;

#[test]
fn after_kills_on_a_full_disk_each_record_is_sent_once_in_one_life_and_gaps_have_none() {
    let (folder, mut has_part) = (TempDir::new().unwrap(), false);
    let full = DiskFault { from: 0, count: u64::MAX, kind: io::ErrorKind::StorageFull };
    for seed in 0..40 {
        let (disk, mut stored) = (SimulatedDisk::new(seed), StoredRecords::default());
        let (mut now, mut end) = (Instant::now(), 0);
        // The records of each process with room on the disk, and without.
        for (with_room, without) in [(5, 6), (0, 3), (0, 3), (2, 0)] {
            let (stream, boot) = ("brake".to_owned(), BootId::current().unwrap());
            let config = SpoolConfig { stream, boot, budget: BUDGET_MIN };
            let mut writer = SpoolWriter::with_storage(disk.clone(), config).unwrap();
            let cloud = Cloud::load(DurableFile::new(folder.path().join("cloud.json"))).0;
            let (spools, (out, mut frames)) = (SimulatedSpool(disk.clone()), channel(9));
            let mut uplink = Uplink::new(spools, cloud, stored.cursors.clone(), out);
            for (count, fault) in [(with_room, None), (without, Some(full))] {
                if count > 0 {
                    disk.set_fault(fault);
                }
                for _ in 0..count {
                    let (kind, payload) = record("lambdas/brake", "the road is dark");
                    let time = SpoolTime { since_boot_ns: writer.status().next, wall_ns: 1 };
                    writer.append(kind, time, &payload).unwrap();
                }
                for _ in 0..20 {
                    assert!(count == 0 || writer.commit().is_ok() == fault.is_none());
                    now += INTERVAL;
                    assert!(uplink.look(true, now));
                    while let Ok(Body::Records(batch)) = frames.try_recv() {
                        assert!(uplink.acknowledged(&stored.store(&batch), now));
                    }
                }
            }
            end = writer.status().next;
        }
        // Each number is in a record, or in a gap, which has the number after it.
        let (lines, mut next) = (stored.of_life("lambdas/brake", 1, 0), 0);
        for line in &lines {
            assert_eq!(line.seq, next, "seed {seed}");
            next = line.record["to"].as_u64().map_or(next, |to| to + 1) + 1;
        }
        // Up to six that were not committed were written whole.
        let records = lines.len() - gaps(&lines).len();
        assert!(next == end && (7..=13).contains(&records), "seed {seed}: {records} records");
        has_part |= (8..13).contains(&records);
    }
    assert!(has_part);
}
