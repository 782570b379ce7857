//! Frozen image: the camera keeps sending the same image while the car moves.
//!
//! Images are compared small and grey, so that the noise of the sensor and of JPEG does not hide a
//! repetition. The host scales them down; only 2,304 bytes are copied into the lambda.

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};

const WIDTH: u32 = 64;
const HEIGHT: u32 = 36;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;

struct FrozenImage {
    speed: Topic,
    forward: Field,
    moving_mps: f64,
    detector: FreezeDetector,
}

impl Lambda for FrozenImage {
    fn init(config: &Config) -> Result<Self> {
        let speed = input("speed")?;
        let forward = speed.field("twist.linear.x")?;
        let (limit, frames) = (config.real("same_luma")?, config.integer("frames")?);
        let detector = FreezeDetector {
            limit,
            frames,
            before: vec![0; PIXELS],
            now: vec![0; PIXELS],
            same: 0,
            seen: false,
        };
        Ok(Self { speed, forward, moving_mps: config.real("moving_mps")?, detector })
    }

    fn on_event(&mut self, camera: Sample) -> Result<()> {
        // A standing car gets equal images from a working camera.
        let Some(speed) = self.speed.newest() else { return Ok(()) };
        let speed = speed.number(&self.forward)?;
        let moves = speed.abs() >= self.moving_mps;
        camera.as_frame()?.resize(WIDTH, HEIGHT)?.to_gray()?.copy_to(&mut self.detector.now)?;
        if self.detector.freezes(moves) {
            event("frozen-image", self.detector.same as f64).with("speed_mps", speed).send()?;
        }
        Ok(())
    }
}

struct FreezeDetector {
    /// Mean difference of two images, in grey levels of 255, below which they are equal.
    limit: f64,
    /// Number of consecutive images equal to the previous one after which the camera is frozen.
    frames: i64,
    before: Vec<u8>,
    now: Vec<u8>,
    same: i64,
    seen: bool,
}

impl FreezeDetector {
    /// Adds the image in `now`. Returns whether it shows that the camera is frozen, once per
    /// freeze.
    fn freezes(&mut self, moves: bool) -> bool {
        let is_same = self.seen && difference(&self.before, &self.now) < self.limit;
        self.seen = true;
        std::mem::swap(&mut self.before, &mut self.now);
        self.same = if is_same && moves { self.same + 1 } else { 0 };
        self.same == self.frames
    }
}

/// Returns the mean absolute difference of two grey images of the same size.
fn difference(a: &[u8], b: &[u8]) -> f64 {
    let sum: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.len() as f64
}

gleaner_sdk::lambda!(FrozenImage);

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the indices of the images, each of one grey level, at which the camera is reported
    /// as frozen.
    fn frozen(greys: &[u8], moves: bool) -> Vec<usize> {
        let mut detector = FreezeDetector {
            limit: 0.1,
            frames: 3,
            before: vec![0; 9],
            now: vec![0; 9],
            same: 0,
            seen: false,
        };
        let mut freezes = |grey: u8| {
            detector.now.fill(grey);
            detector.freezes(moves)
        };
        greys
            .iter()
            .enumerate()
            .filter_map(|(index, grey)| freezes(*grey).then_some(index))
            .collect()
    }

    #[test]
    fn a_repeated_image_is_reported_once_per_freeze() {
        assert_eq!(frozen(&[0, 0, 0, 0, 0, 0, 9, 9, 9, 9, 9], true), [3, 9]);
        assert_eq!(frozen(&[1, 2, 3, 3, 3, 4, 4, 4, 5], true), []);
    }

    #[test]
    fn a_standing_car_is_ignored() {
        assert_eq!(frozen(&[0; 10], false), []);
    }
}
