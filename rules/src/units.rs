//! Parses and formats sizes and durations, as in `lambda.toml`: `"2 MiB"`, `"50ms"`.

/// Units of sizes, largest first: a size is formatted in the first that divides it.
const SIZES: [(&str, u64); 4] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10), ("B", 1)];

/// Units of durations, largest first: a duration is formatted in the first that divides it.
const TIMES: [(&str, u64); 6] = [
    ("h", 3_600_000_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

/// Help text on the form of a size.
pub const SIZE_RULE: &str =
    "write a whole number and its unit, B, KiB, MiB or GiB, for example \"2 MiB\"";
/// Help text on the form of a duration.
pub const TIME_RULE: &str =
    "write a number and its unit, us, ms, s, min or h, for example \"50ms\" or \"1.5s\"";

/// Splits `2 MiB` or `2MiB` into number and unit, which may be empty.
fn split(text: &str) -> (&str, &str) {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    (number, unit.strip_prefix(' ').unwrap_or(unit))
}

fn factor(units: &[(&str, u64)], unit: &str) -> Option<u64> {
    units.iter().find(|(name, _)| *name == unit).map(|(_, factor)| *factor)
}

/// Parses a size into bytes; without a unit it is a number of bytes.
pub fn size(text: &str) -> Option<u64> {
    let (number, unit) = split(text);
    let factor = if unit.is_empty() { 1 } else { factor(&SIZES, unit)? };
    number.parse::<u64>().ok()?.checked_mul(factor)
}

/// Parses a duration into nanoseconds; fractions of a nanosecond are refused.
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

/// Parses digits only: `u64::from_str` also accepts a sign.
fn digits(text: &str) -> Option<u64> {
    if text.bytes().all(|byte| byte.is_ascii_digit()) { text.parse().ok() } else { None }
}

/// Formats a size in the largest unit that gives a whole number: `2 MiB`, `1536 B`.
pub fn size_in_words(bytes: u64) -> String {
    in_largest(bytes, &SIZES, " ")
}

/// Formats a duration in the largest unit that gives a whole number: `1500ms`, `5s`, `2min`.
pub fn duration_in_words(ns: u64) -> String {
    if ns == 0 { "0s".to_owned() } else { in_largest(ns, &TIMES, "") }
}

fn in_largest(n: u64, units: &[(&str, u64)], gap: &str) -> String {
    let fits = |(_, factor): &&(&str, u64)| n != 0 && n.is_multiple_of(*factor);
    let (unit, factor) = units.iter().find(fits).unwrap_or(&units[units.len() - 1]);
    format!("{}{gap}{unit}", n / factor)
}
