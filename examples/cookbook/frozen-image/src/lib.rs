//! Frozen image: the camera goes on sending, but always the same picture, while the car moves.
//!
//! Pictures are compared small and grey, so that the noise of a sensor and of JPEG does not hide
//! it. The host makes them small; what comes into the lambda is 2,304 bytes.

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input};

const WIDTH: u32 = 64;
const HEIGHT: u32 = 36;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;

struct FrozenImage {
    speed: Topic,
    forward: Field,
    moving_mps: f64,
    camera: Camera,
}

impl Lambda for FrozenImage {
    fn init(config: &Config) -> Result<Self> {
        let speed = input("speed")?;
        let forward = speed.field("twist.linear.x")?;
        let (limit, frames) = (config.real("same_luma")?, config.integer("frames")?);
        let camera = Camera {
            limit,
            frames,
            before: vec![0; PIXELS],
            now: vec![0; PIXELS],
            same: 0,
            seen: false,
        };
        Ok(Self { speed, forward, moving_mps: config.real("moving_mps")?, camera })
    }

    fn on_event(&mut self, picture: Sample) -> Result<()> {
        // Who stands sees the same, and rightly so.
        let Some(speed) = self.speed.newest() else { return Ok(()) };
        let speed = speed.number(&self.forward)?;
        let moves = speed.abs() >= self.moving_mps;
        picture.as_frame()?.resize(WIDTH, HEIGHT)?.to_gray()?.copy_to(&mut self.camera.now)?;
        if self.camera.freezes(moves) {
            event("frozen-image", self.camera.same as f64).with("speed_mps", speed).send()?;
        }
        Ok(())
    }
}

struct Camera {
    /// Mean difference of two pictures, in grey levels of 255, below which they are the same.
    limit: f64,
    /// So many pictures in a row that are the same as the one before are a frozen camera.
    frames: i64,
    before: Vec<u8>,
    now: Vec<u8>,
    same: i64,
    seen: bool,
}

impl Camera {
    /// Whether the picture in `now` is the one that makes it sure; once for each time that it
    /// freezes.
    fn freezes(&mut self, moves: bool) -> bool {
        let is_same = self.seen && difference(&self.before, &self.now) < self.limit;
        self.seen = true;
        std::mem::swap(&mut self.before, &mut self.now);
        self.same = if is_same && moves { self.same + 1 } else { 0 };
        self.same == self.frames
    }
}

/// Mean absolute difference of two grey pictures of the same size.
fn difference(a: &[u8], b: &[u8]) -> f64 {
    let sum: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.len() as f64
}

gleaner_sdk::lambda!(FrozenImage);

#[cfg(test)]
mod tests {
    use super::*;

    /// Which pictures, each of one grey, make it sure that the camera is frozen.
    fn frozen(greys: &[u8], moves: bool) -> Vec<usize> {
        let mut camera = Camera {
            limit: 0.1,
            frames: 3,
            before: vec![0; 9],
            now: vec![0; 9],
            same: 0,
            seen: false,
        };
        let mut freezes = |grey: u8| {
            camera.now.fill(grey);
            camera.freezes(moves)
        };
        greys
            .iter()
            .enumerate()
            .filter_map(|(index, grey)| freezes(*grey).then_some(index))
            .collect()
    }

    #[test]
    fn the_same_picture_again_and_again_is_told_once_each_time() {
        assert_eq!(frozen(&[0, 0, 0, 0, 0, 0, 9, 9, 9, 9, 9], true), [3, 9]);
        assert_eq!(frozen(&[1, 2, 3, 3, 3, 4, 4, 4, 5], true), []);
    }

    #[test]
    fn a_car_that_stands_sees_the_same() {
        assert_eq!(frozen(&[0; 10], false), []);
    }
}
