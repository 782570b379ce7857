//! Frames of 1080p in a file, the same for all programs.

use std::fs::File;
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use gleaner_test_support::random::XorShift64;

/// Width of a frame in pixels.
pub(super) const WIDTH: u32 = 1920;
/// Height of a frame in pixels.
pub(super) const HEIGHT: u32 = 1080;
/// Number of different frames: one equal to the last would not run again.
const FRAMES: usize = 8;
/// Bytes of a frame: bgr8.
const BYTES: usize = 3 * WIDTH as usize * HEIGHT as usize;

pub(super) struct FrameFile {
    pub(super) path: PathBuf,
    file: File,
    buffer: Vec<u8>,
}

impl FrameFile {
    /// Writes it: a road under a sky, some bright boxes, and noise.
    pub(super) fn create(folder: &Path) -> Self {
        let path = folder.join("frames.bgr");
        let mut file = File::create(&path).expect("the folder is writable");
        let mut random = XorShift64(0x1234_5678_9abc_def1);
        for number in 0..FRAMES {
            let mut frame = Vec::with_capacity(BYTES);
            for y in 0..HEIGHT as usize {
                for x in 0..WIDTH as usize {
                    let in_box = (x / 40 + 7 * number) % 11 == 3 && (y / 60) % 5 == 2;
                    let level = if in_box { 200 } else { 40 + y / 9 + x / 60 };
                    let noise = random.below(16);
                    let sky = if y < HEIGHT as usize / 2 { 40 } else { 0 };
                    let of = |level: usize| level.min(255) as u8;
                    frame.extend([of(level + noise + sky), of(level + noise), of(level)]);
                }
            }
            file.write_all(&frame).expect("the disk has room");
        }
        let file = File::open(&path).expect("it was written");
        Self { path, file, buffer: vec![0; BYTES] }
    }

    /// Reads the next frame.
    pub(super) fn frame(&mut self, number: usize) -> &[u8] {
        let offset = number % FRAMES * BYTES;
        self.file.read_exact_at(&mut self.buffer, offset as u64).expect("it was written");
        &self.buffer
    }
}
