//! What a fuzzer begins with: small sound inputs, made anew when they are needed, so that none has
//! to be kept.

pub mod bag;
pub mod calls;
pub mod drive;
pub mod image;
pub mod journal;
pub mod link;
pub mod manifest;
pub mod message;

use std::fs;
use std::io;
use std::path::Path;

use crate::TARGETS;

/// Writes the seeds of each target to files in a folder of its name, its words to `<name>.dict`, as
/// libFuzzer reads them, and the longest input to `<name>.longest`, in bytes.
///
/// # Errors
///
/// What the system says.
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

/// libFuzzer knows bytes as hexadecimal digits, and no other escapes that are worth it.
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
