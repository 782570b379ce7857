//! Sizes of the memory of a topic.

use gleaner_buffers::shared::SharedLayout;

/// Samples up to this size are small: twice as many as a reader asks for cost little.
const SMALL_BYTES: u64 = 64 << 10;
/// Memory for slots beyond the shown ones that are used in turn, and the number of these. The more
/// there are, the less often the writer reads the hazards of all readers.
const SPARE_BYTES: u64 = 1 << 20;
const SPARE: std::ops::RangeInclusive<u64> = 2..=64;
/// Readers with holds like the first one's that a region has room for, if its slots and bytes stay
/// below these limits. They are reserved addresses: memory is used once readers hold samples.
const READERS: u64 = 32;
const MAX_SLOTS: u64 = 1 << 20;
const MAX_RESERVED: u64 = 64 << 30;
/// Most bytes of a region that are present from the start. Beyond, and where no reader states the
/// size of samples, a slot is present once it was used: its first sample takes longer.
const MAX_PRESENT: usize = 256 << 20;

#[derive(Debug, Clone, Copy)]
pub(crate) struct RegionSizes {
    pub(crate) layout: SharedLayout,
    /// Slots that are used in turn while readers hold no samples.
    pub(crate) warm: u32,
    /// Bytes that are present from the start.
    pub(crate) present: usize,
}

impl RegionSizes {
    /// Returns the sizes of a region whose first reader asks for `depth` samples of `max_bytes`,
    /// which its grant states or not, and holds up to `quota` of them.
    pub(crate) fn of(max_bytes: u64, is_stated: bool, depth: u32, quota: u32) -> Self {
        let depth = if max_bytes <= SMALL_BYTES { depth.next_power_of_two() } else { depth };
        let spare = (SPARE_BYTES / max_bytes.max(1)).clamp(*SPARE.start(), *SPARE.end());
        let warm = u64::from(depth) + 1 + spare;
        let layout = |readers: u64| SharedLayout {
            depth,
            slots: u32::try_from(warm + readers * u64::from(quota)).unwrap_or(u32::MAX),
            slot_bytes: max_bytes,
        };
        let is_usual = |readers: &u64| {
            let layout = layout(*readers);
            let bytes = layout.bytes_needed().map_or(u64::MAX, |bytes| bytes as u64);
            u64::from(layout.slots) <= MAX_SLOTS && bytes <= MAX_RESERVED
        };
        let readers = (1..=READERS).rev().find(is_usual).unwrap_or(1);
        let layout = layout(readers);
        let warm = u32::try_from(warm).unwrap_or(u32::MAX);
        let present = layout.bytes_of_first(if is_stated { warm } else { 0 }).min(MAX_PRESENT);
        Self { layout, warm, present }
    }
}

/// Returns the size, in bytes, of the largest sample of a topic whose size no grant states. Larger
/// samples are counted and not passed on, so this is generous: memory is used for actual samples.
pub(crate) fn usual_bytes(type_name: &str) -> u64 {
    match type_name.rsplit('/').next() {
        Some("Image" | "PointCloud2") => 32 << 20,
        _ => 8 << 20,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_samples_get_room_for_many_readers() {
        let sizes = RegionSizes::of(256, true, 100, 40);
        assert_eq!(sizes.layout.depth, 128);
        assert_eq!(sizes.layout.slots, 128 + 1 + 64 + 32 * 40);
        assert_eq!(sizes.warm, 128 + 1 + 64);
        let bytes = sizes.layout.bytes_needed().unwrap();
        assert!(sizes.present > 128 * 256 && sizes.present < bytes / 3, "{sizes:?} {bytes}");
    }

    #[test]
    fn large_samples_get_their_exact_depth() {
        let image = 6 << 20;
        let sizes = RegionSizes::of(image, true, 3, 4);
        assert_eq!((sizes.layout.depth, sizes.warm), (3, 3 + 1 + 2));
        assert_eq!(sizes.layout.slots, 6 + 32 * 4);
        assert!(sizes.present as u64 > 6 * image && (sizes.present as u64) < 7 * image);
        let unstated = RegionSizes::of(image, false, 3, 4);
        assert!(unstated.present < 64 << 10, "{unstated:?}");
    }

    #[test]
    fn the_largest_grants_are_bounded() {
        let sizes = RegionSizes::of(1 << 30, true, 8, 16);
        assert!(sizes.layout.bytes_needed().unwrap() as u64 <= MAX_RESERVED);
        assert_eq!(sizes.present, MAX_PRESENT);
        let most = RegionSizes::of(1 << 30, true, 131_072, 16 * 65_535 + 2048);
        assert_eq!(u64::from(most.layout.slots), 131_072 + 1 + 2 + 16 * 65_535 + 2048);
    }
}
