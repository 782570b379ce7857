//! Seeds and dictionaries of all targets: small valid inputs, generated when needed, so that none
//! is stored.

pub mod bag;
pub mod calls;
pub mod drive;
pub mod fleet;
pub mod image;
pub mod ingress;
pub mod journal;
pub mod link;
pub mod manifest;
pub mod message;
pub mod model;
pub mod spool;
pub mod trust;

use std::fs;
use std::io;
use std::path::Path;

use crate::TARGETS;

/// Writes the seeds of each target to files in a folder of its name, its dictionary to
/// `<name>.dict` in libFuzzer's format, and the longest input to `<name>.longest`, in bytes.
pub fn write(folder: &Path) -> io::Result<()> {
    for target in TARGETS {
        let seeds = folder.join(target.name);
        fs::create_dir_all(&seeds)?;
        for (number, seed) in (target.seeds)().into_iter().enumerate() {
            fs::write(seeds.join(format!("{number:02}")), seed)?;
        }
        let words = target.words.iter().map(|word| format!("\"{}\"\n", escaped(word)));
        fs::write(folder.join(format!("{}.dict", target.name)), words.collect::<String>())?;
        fs::write(folder.join(format!("{}.longest", target.name)), target.longest.to_string())?;
    }
    Ok(())
}

/// Escapes as libFuzzer reads it: bytes as hexadecimal digits.
fn escaped(word: &str) -> String {
    let plain = |byte: u8| (byte.is_ascii_graphic() || byte == b' ') && !b"\"\\".contains(&byte);
    word.bytes()
        .map(
            |byte| {
                if plain(byte) { char::from(byte).to_string() } else { format!("\\x{byte:02x}") }
            },
        )
        .collect()
}
