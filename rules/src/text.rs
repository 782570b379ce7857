//! Texts of a lambda, made to fit, and words for messages.

use std::fmt;

/// The longest start of `text` that fits into `bytes` and ends at a character boundary.
pub fn cut(text: &str, bytes: usize) -> &str {
    &text[..text.floor_char_boundary(bytes)]
}

/// `` `a`, `b` ``, or `none`.
pub fn quoted<S: AsRef<str>>(names: impl IntoIterator<Item = S>) -> String {
    let listed = names.into_iter().map(|name| format!("`{}`", name.as_ref())).collect::<Vec<_>>();
    if listed.is_empty() { "none".to_owned() } else { listed.join(", ") }
}

/// `text` with its control characters written out, so that none acts on a terminal.
pub fn visible(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        match character.is_control() || turns_text(character) {
            true => shown.extend(character.escape_default()),
            false => shown.push(character),
        }
    }
    shown
}

/// Whether it makes a terminal show text in another order than it is written: the bidirectional
/// controls of Unicode.
fn turns_text(character: char) -> bool {
    matches!(character, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// A number of bytes for people: exact below 1 MiB, then in tenths of a MiB. What is needed rounds
/// up and what is allowed rounds down, so that a message never says "8 MiB, and 8 MiB is allowed".
#[derive(Clone, Copy, Debug)]
pub struct RoundedBytes {
    bytes: u64,
    tenths: u64,
}

const MIB: u64 = 1 << 20;

impl RoundedBytes {
    /// What is needed.
    pub fn up(bytes: u64) -> Self {
        let tenths = (bytes / MIB * 10).saturating_add((bytes % MIB * 10).div_ceil(MIB));
        Self { bytes, tenths }
    }

    /// What is allowed.
    pub fn down(bytes: u64) -> Self {
        let tenths = (bytes / MIB * 10).saturating_add(bytes % MIB * 10 / MIB);
        Self { bytes, tenths }
    }
}

impl fmt::Display for RoundedBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.bytes, self.tenths) {
            (bytes, _) if bytes < MIB => write!(f, "{bytes} bytes"),
            (_, tenths) if tenths % 10 == 0 => write!(f, "{} MiB", tenths / 10),
            (_, tenths) => write!(f, "{}.{} MiB", tenths / 10, tenths % 10),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_rounded_against_the_one_who_asks() {
        assert_eq!(RoundedBytes::down(8 << 20).to_string(), "8 MiB");
        assert_eq!(RoundedBytes::up((8 << 20) + 1).to_string(), "8.1 MiB");
        assert_eq!(RoundedBytes::down((8 << 20) - 1).to_string(), "7.9 MiB");
        assert_eq!(RoundedBytes::up(12_870_750_000).to_string(), "12274.6 MiB");
        assert_eq!(RoundedBytes::up(768).to_string(), "768 bytes");
        assert_eq!(RoundedBytes::up(u64::MAX).to_string(), "17592186044416 MiB");
    }
}
