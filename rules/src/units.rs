//! Sizes and durations as people write them in `lambda.toml`: `"2 MiB"`, `"50ms"`.

/// Largest first, so that the first that divides a size is the one to show it in.
const SIZES: [(&str, u64); 4] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10), ("B", 1)];

/// Largest first; a duration is written in any, and shown in the first that divides it.
const TIMES: [(&str, u64); 6] = [
    ("h", 3_600_000_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

/// How a size is written.
pub const SIZE_RULE: &str =
    "write a whole number and its unit, B, KiB, MiB or GiB, for example \"2 MiB\"";
/// How a duration is written.
pub const TIME_RULE: &str =
    "write a number and its unit, us, ms, s, min or h, for example \"50ms\" or \"1.5s\"";

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

/// The bytes that `text` stands for; without a unit it is a number of bytes.
pub fn size(text: &str) -> Option<u64> {
    let (number, unit) = split(text);
    let factor = if unit.is_empty() { 1 } else { factor(&SIZES, unit)? };
    number.parse::<u64>().ok()?.checked_mul(factor)
}

/// The nanoseconds that `text` stands for: exact, so it has no parts of one.
pub fn duration(text: &str) -> Option<u64> {
    let (number, unit) = split(text);
    let factor = factor(&TIMES, unit)?;
    let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
    let whole = digits(whole)?.checked_mul(factor)?;
    let scale = u128::from(10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?);
    let part = u128::from(digits(fraction)?) * u128::from(factor);
    let part = part.is_multiple_of(scale).then_some(part / scale)?;
    whole.checked_add(u64::try_from(part).ok()?)
}

/// Digits and nothing else: `u64::from_str` also takes a sign.
fn digits(text: &str) -> Option<u64> {
    if text.bytes().all(|byte| byte.is_ascii_digit()) { text.parse().ok() } else { None }
}

/// A size in the largest unit that keeps it whole: `2 MiB`, `1536 B`.
pub fn size_in_words(bytes: u64) -> String {
    in_largest(bytes, &SIZES, " ")
}

/// A duration in the largest unit that keeps it whole: `1500ms`, `5s`, `2min`.
pub fn duration_in_words(ns: u64) -> String {
    if ns == 0 { "0s".to_owned() } else { in_largest(ns, &TIMES, "") }
}

fn in_largest(n: u64, units: &[(&str, u64)], gap: &str) -> String {
    let fits = |(_, factor): &&(&str, u64)| n != 0 && n.is_multiple_of(*factor);
    let (unit, factor) = units.iter().find(fits).unwrap_or(&units[units.len() - 1]);
    format!("{}{gap}{unit}", n / factor)
}
