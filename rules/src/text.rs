//! Cuts and escapes texts of a lambda, and formats names and sizes for messages.

use std::fmt;

/// Returns the longest prefix of `text` that fits into `bytes` and ends at a character boundary.
pub fn cut(text: &str, bytes: usize) -> &str {
    &text[..text.floor_char_boundary(bytes)]
}

/// Formats names as `` `a`, `b` ``, or `none`.
pub fn quoted<S: AsRef<str>>(names: impl IntoIterator<Item = S>) -> String {
    let listed = names.into_iter().map(|name| format!("`{}`", name.as_ref())).collect::<Vec<_>>();
    if listed.is_empty() { "none".to_owned() } else { listed.join(", ") }
}

/// Cuts `name` for a message: a hostile one must not fill the log.
pub fn shortened(name: &str) -> String {
    const LONGEST: usize = 40;
    match name.char_indices().nth(LONGEST) {
        None => name.to_owned(),
        Some((end, _)) => format!("{}…", &name[..end]),
    }
}

/// Escapes the control characters of `text`, so that none acts on a terminal.
pub fn visible(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        match character.is_control() || is_bidi_control(character) {
            true => shown.extend(character.escape_default()),
            false => shown.push(character),
        }
    }
    shown
}

/// Returns whether it is a bidirectional control of Unicode, which makes a terminal show text in
/// another order.
fn is_bidi_control(character: char) -> bool {
    matches!(
        character,
        '\u{61c}'
            | '\u{200e}'
            | '\u{200f}'
            | '\u{202a}'..='\u{202e}'
            | '\u{2066}'..='\u{2069}'
    )
}

/// A number of bytes for a message: exact below 1 MiB, then in tenths of a MiB. Needed bytes are
/// rounded up and allowed ones down, so that a message never reads "8 MiB, and 8 MiB is allowed".
#[derive(Clone, Copy, Debug)]
pub struct RoundedBytes {
    bytes: u64,
    tenths: u64,
}

const MIB: u64 = 1 << 20;

impl RoundedBytes {
    /// Rounds needed bytes.
    pub fn up(bytes: u64) -> Self {
        let tenths = (bytes / MIB * 10).saturating_add((bytes % MIB * 10).div_ceil(MIB));
        Self { bytes, tenths }
    }

    /// Rounds allowed bytes.
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
    fn needed_sizes_are_rounded_up_and_allowed_ones_down() {
        assert_eq!(RoundedBytes::down(8 << 20).to_string(), "8 MiB");
        assert_eq!(RoundedBytes::up((8 << 20) + 1).to_string(), "8.1 MiB");
        assert_eq!(RoundedBytes::down((8 << 20) - 1).to_string(), "7.9 MiB");
        assert_eq!(RoundedBytes::up(12_870_750_000).to_string(), "12274.6 MiB");
        assert_eq!(RoundedBytes::up(768).to_string(), "768 bytes");
        assert_eq!(RoundedBytes::up(u64::MAX).to_string(), "17592186044416 MiB");
    }
}
