//! The place in a stream after which the cloud lacks records.

use std::path::Path;

use gleaner_base::hex;
use gleaner_fleet::Cursor;
use gleaner_spool::{SpoolError, SpoolItem, SpoolReader};

/// Opens a stream after what the cloud has of it; also returns the number of its life.
///
/// A stream that does not have the record that the cloud has under its number lost its records,
/// and was begun again: it is sent from its begin, as another life.
pub(super) fn resume(
    folder: &Path,
    stream: &str,
    cursor: Option<&Cursor>,
) -> Result<(u64, SpoolReader), SpoolError> {
    let oldest = |life| Ok((life, SpoolReader::open(folder, stream, None)?));
    let Some(Cursor { life, next, seq, boot, boot_ns, .. }) = cursor else { return oldest(1) };
    // Of a stream of nothing but gaps, the cloud has no record to compare, but an end.
    let last = if boot.is_empty() { next.checked_sub(1) } else { Some(*seq) };
    if let Some(last) = last {
        let mut reader = SpoolReader::open(folder, stream, Some(last))?;
        let is_same = match reader.next().transpose()? {
            Some(SpoolItem::Record(record)) if record.seq == last => {
                hex(&record.boot.0) == *boot && record.time.since_boot_ns == *boot_ns
            }
            // The budget has removed it.
            Some(SpoolItem::Record(_) | SpoolItem::Gap(_)) => true,
            Some(SpoolItem::Torn(_)) | None => false,
        };
        if !is_same {
            return oldest(life.saturating_add(1));
        }
    }
    Ok((*life, SpoolReader::open(folder, stream, Some(*next))?))
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU8;

    use gleaner_spool::{BUDGET_MIN, BootId, SpoolConfig, SpoolTime, SpoolWriter};

    use super::*;

    const BOOT: BootId = BootId([7; 16]);

    /// Appends records at these times since the boot.
    fn write(folder: &Path, times: std::ops::Range<u64>, payload: &[u8]) {
        let config = SpoolConfig { stream: "s".to_owned(), boot: BOOT, budget: BUDGET_MIN };
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
        let (life, reader) = resume(folder, "s", cursor).unwrap();
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
    fn a_position_without_a_record_is_no_way_to_skip_records() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), 100..110, b"x");
        let gaps = |next| Cursor { seq: 0, boot: String::new(), boot_ns: 0, ..cursor(next, 0) };
        for next in [3, 11, 1 << 40, u64::MAX] {
            assert_eq!(resumed(folder.path(), Some(&gaps(next))), (4, Some(100)), "{next}");
        }
        assert_eq!(resumed(folder.path(), Some(&cursor(u64::MAX, 0))), (4, Some(100)));
        let last = Cursor { life: u64::MAX, ..cursor(50, 149) };
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
