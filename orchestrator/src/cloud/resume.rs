//! The place in a stream after which the cloud lacks records.

use gleaner_base::hex;
use gleaner_fleet::Cursor;
use gleaner_spool::{BootId, SpoolError, SpoolItem, SpoolReader, SpoolStorage};

/// Opens a stream after what the cloud has of it; also returns the number of its life.
///
/// A stream that does not have the record that the cloud has under its number has lost records:
/// others have their numbers, and are sent as another life. It begins after the newest record that
/// both have, or with the oldest one if that is not certain. A cloud without the stream gets all
/// numbers, those that the spool has lost before as a gap.
pub(super) fn resume<S: SpoolStorage>(
    open: &dyn Fn() -> Result<S, SpoolError>,
    stream: &str,
    cursor: Option<&Cursor>,
) -> Result<(u64, SpoolReader<S>), SpoolError> {
    let read = |from| Ok(SpoolReader::with_storage(open()?, stream, from));
    let Some(Cursor { life, next, seq, boot, boot_ns, .. }) = cursor else {
        return Ok((1, read(Some(0))?));
    };
    // Of a stream of nothing but gaps, the cloud has no record to compare, but an end.
    let last = if boot.is_empty() { next.checked_sub(1) } else { Some(*seq) };
    // Begun again after the vehicle was cut off: what the spool has lost was sent before.
    if *next == 0 {
        return Ok((*life, read(None)?));
    }
    if let Some(last) = last {
        let mut reader = read(Some(last))?;
        let is_same = match reader.next().transpose()? {
            Some(SpoolItem::Record(record)) if record.seq == last => {
                hex(&record.boot.0) == *boot && record.time.since_boot_ns == *boot_ns
            }
            // The budget has removed it.
            Some(SpoolItem::Record(_) | SpoolItem::Gap(_)) => true,
            Some(SpoolItem::Torn(_)) | None => false,
        };
        // After the record, the cloud may have gaps that this disk has lost.
        let is_end = |number| {
            let item = read(Some(number))?.next().transpose()?;
            Ok::<_, SpoolError>(matches!(item, Some(SpoolItem::Record(_) | SpoolItem::Gap(_))))
        };
        if !is_same || (*next > last.saturating_add(1) && !is_end(*next - 1)?) {
            let from = after_common(read(None)?, boot, *boot_ns)?;
            return Ok((life.saturating_add(1), read(from)?));
        }
    }
    Ok((*life, read(Some(*next))?))
}

/// Returns the number after the newest record that is not newer than one of this boot and time.
/// The cloud has that one, and older records of the stream were sent before it.
///
/// `None` if the spool has no record of that boot, so that it does not show which boots are older,
/// or if that is the current boot: then no power cut has taken the record, and the spool may be
/// that of another machine.
fn after_common<S: SpoolStorage>(
    reader: SpoolReader<S>,
    boot: &str,
    boot_ns: u64,
) -> Result<Option<u64>, SpoolError> {
    if BootId::current().is_ok_and(|current| hex(&current.0) == boot) {
        return Ok(None);
    }
    let (mut after, mut has_boot) = (None, false);
    for item in reader {
        let SpoolItem::Record(record) = item? else { continue };
        let is_of_boot = hex(&record.boot.0) == boot;
        // The first newer one counts: events of several threads may be out of order by a little.
        let is_newer = if is_of_boot { record.time.since_boot_ns > boot_ns } else { has_boot };
        if is_newer {
            return Ok(after);
        }
        has_boot |= is_of_boot;
        after = Some(record.seq + 1);
    }
    Ok(after.filter(|_| has_boot))
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU8;
    use std::path::Path;

    use gleaner_spool::{BUDGET_MIN, SpoolConfig, SpoolFolder, SpoolTime, SpoolWriter};

    use super::*;

    const BOOT: BootId = BootId([7; 16]);

    /// Appends records at these times since the boot.
    fn write(folder: &Path, times: std::ops::Range<u64>, payload: &[u8]) {
        write_in(BOOT, folder, times, payload);
    }

    fn write_in(boot: BootId, folder: &Path, times: std::ops::Range<u64>, payload: &[u8]) {
        let config = SpoolConfig { stream: "s".to_owned(), boot, budget: BUDGET_MIN };
        let mut writer = SpoolWriter::open(folder, config).unwrap();
        for since_boot_ns in times {
            let time = SpoolTime { since_boot_ns, wall_ns: 1 };
            writer.append(NonZeroU8::MIN, time, payload).unwrap();
            writer.commit().unwrap();
        }
    }

    /// Returns the cursor of a cloud that has the first `next` records of the stream.
    fn cursor(next: u64, boot_ns: u64) -> Cursor {
        let (boot, stream) = (hex(&BOOT.0), "s".to_owned());
        Cursor { stream, life: 3, next, seq: next - 1, boot, boot_ns }
    }

    /// Returns the life, and the time of the first record that is sent.
    fn resumed(folder: &Path, cursor: Option<&Cursor>) -> (u64, Option<u64>) {
        let (life, reader) = resume(&|| SpoolFolder::readable(folder), "s", cursor).unwrap();
        let first = reader.filter_map(Result::ok).find_map(|item| match item {
            SpoolItem::Record(record) => Some(record.time.since_boot_ns),
            _ => None,
        });
        (life, first)
    }

    #[test]
    fn a_stream_goes_on_after_what_the_cloud_has() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), 100..110, b"x");
        assert_eq!(resumed(folder.path(), None), (1, Some(100)));
        assert_eq!(resumed(folder.path(), Some(&cursor(4, 103))), (3, Some(104)));
        assert_eq!(resumed(folder.path(), Some(&cursor(10, 109))), (3, None));
    }

    #[test]
    fn a_stream_that_was_begun_again_is_sent_from_its_begin_as_another_life() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), 200..205, b"x");
        assert_eq!(resumed(folder.path(), Some(&cursor(4, 103))), (4, Some(200)));
        assert_eq!(resumed(folder.path(), Some(&cursor(50, 149))), (4, Some(200)), "it is shorter");
    }

    #[test]
    fn records_that_a_power_cut_took_are_no_reason_to_send_those_before_them_again() {
        let folder = tempfile::tempdir().unwrap();
        write_in(BootId([6; 16]), folder.path(), 500..510, b"x");
        write(folder.path(), 100..105, b"x");
        // The cloud has five more: up to number 19.
        let lost = cursor(20, 109);
        assert_eq!(resumed(folder.path(), Some(&lost)), (4, None));
        for boot in [8, 5] {
            write_in(BootId([boot; 16]), folder.path(), 300..310, b"x");
            assert_eq!(resumed(folder.path(), Some(&lost)), (4, Some(300)), "number 15");
        }
        // Without a record of the boot, it is not known which ones the cloud has.
        let unknown = Cursor { boot: hex(&[9; 16]), ..lost };
        assert_eq!(resumed(folder.path(), Some(&unknown)), (4, Some(500)));
    }

    #[test]
    fn without_a_power_cut_all_records_are_sent_as_another_life() {
        let (folder, boot) = (tempfile::tempdir().unwrap(), BootId::current().unwrap());
        write_in(boot, folder.path(), 100..105, b"x");
        let other = Cursor { boot: hex(&boot.0), ..cursor(20, 109) };
        assert_eq!(resumed(folder.path(), Some(&other)), (4, Some(100)));
    }

    #[test]
    fn a_position_without_a_record_is_no_way_to_skip_records() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), 100..110, b"x");
        let gaps = |next| Cursor { seq: 0, boot: String::new(), boot_ns: 0, ..cursor(next, 0) };
        for next in [3, 11, 1 << 40, u64::MAX] {
            assert_eq!(resumed(folder.path(), Some(&gaps(next))), (4, Some(100)), "{next}");
        }
        assert_eq!(resumed(folder.path(), Some(&cursor(u64::MAX, 0))), (4, Some(100)));
        let last = Cursor { life: u64::MAX, ..gaps(50) };
        assert_eq!(resumed(folder.path(), Some(&last)), (u64::MAX, Some(100)));
    }

    #[test]
    fn records_that_the_budget_removed_are_the_same_life() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), 100..250, &[0; 2000]);
        let (life, first) = resumed(folder.path(), Some(&cursor(2, 101)));
        assert!(life == 3 && first.is_some_and(|first| first > 102), "{first:?}");
    }
}
