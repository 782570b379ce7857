//! Sizes and durations as people write them in `lambda.toml`: `"2 MiB"`, `"50ms"`.

/// Largest first, so that the first that divides a size is the one to show it in.
const SIZES: [(&str, u64); 4] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10), ("B", 1)];
const TIMES: [(&str, u64); 6] = [
    ("h", 3_600_000_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];
pub(super) const SIZE_RULE: &str = "write a whole number and its unit, B, KiB, MiB or GiB, for example \"2 MiB\"";
pub(super) const TIME_RULE: &str = "write a number and its unit, us, ms, s, min or h, for example \"50ms\" or \"1.5s\"";

/// The number and the unit of `2 MiB` or `2MiB`; without a unit the second is empty.
fn split(text: &str) -> (&str, &str) {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    (number, unit.strip_prefix(' ').unwrap_or(unit))
}

fn factor(units: &[(&str, u64)], unit: &str) -> Option<u64> {
    units.iter().find(|(name, _)| *name == unit).map(|(_, factor)| *factor)
}

/// Bytes.
pub(super) fn size(text: &str) -> Option<u64> {
    let (number, unit) = split(text);
    let factor = if unit.is_empty() { 1 } else { factor(&SIZES, unit)? };
    number.parse::<u64>().ok()?.checked_mul(factor)
}

/// Nanoseconds, which must be whole.
pub(super) fn duration(text: &str) -> Option<u64> {
    let (number, unit) = split(text);
    let factor = factor(&TIMES, unit)?;
    let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
    let whole = digits(whole)?.checked_mul(factor)?;
    let scale = u128::from(10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?);
    let part = u128::from(digits(fraction)?) * u128::from(factor);
    let part = part.is_multiple_of(scale).then_some(part / scale)?;
    whole.checked_add(u64::try_from(part).ok()?)
}

fn digits(text: &str) -> Option<u64> {
    if text.bytes().all(|byte| byte.is_ascii_digit()) { text.parse().ok() } else { None }
}

/// In the largest unit that keeps it whole.
pub(super) fn size_in_words(bytes: u64) -> String {
    let fits = |(_, factor): &&(&str, u64)| bytes != 0 && bytes.is_multiple_of(*factor);
    let (unit, factor) = SIZES.iter().find(fits).unwrap_or(&SIZES[SIZES.len() - 1]);
    format!("{} {unit}", bytes / factor)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_durations_are_read_exactly_or_not_at_all() {
        assert_eq!(
            ["2 MiB", "512KiB", "17", "1.5 MiB", "2 MB"].map(size),
            [Some(2 << 20), Some(512 << 10), Some(17), None, None]
        );
        let times = ["1.5s", "100us", "0.000000001s", "5", "0.0000000001s"].map(duration);
        assert_eq!(times, [Some(1_500_000_000), Some(100_000), Some(1), None, None]);
        assert_eq!([0, 1 << 20, 1536].map(size_in_words), ["0 B", "1 MiB", "1536 B"]);
    }
}
