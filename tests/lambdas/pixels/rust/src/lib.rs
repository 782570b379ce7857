//! Hashes the pixels of every frame (FNV-1a, 32 bits, rows without padding); reports it as a label.

use gleaner_sdk::{Config, Lambda, Result, Sample, event};

struct PixelHasher;

impl Lambda for PixelHasher {
    fn init(_config: &Config) -> Result<Self> {
        Ok(Self)
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let hash = sample.as_frame()?.rows().fold(0x811c_9dc5, |hash, row| fnv1a(hash, &row));
        event(&format!("{hash:08x}"), 0.0).send()
    }
}

fn fnv1a(hash: u32, bytes: &[u8]) -> u32 {
    bytes.iter().fold(hash, |hash, byte| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193))
}

gleaner_sdk::lambda!(PixelHasher);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        assert_eq!(fnv1a(0x811c_9dc5, b""), 0x811c_9dc5);
        assert_eq!(fnv1a(0x811c_9dc5, b"a"), 0xe40c_292c);
        assert_eq!(fnv1a(0x811c_9dc5, b"foobar"), 0xbf9c_f968);
    }
}
