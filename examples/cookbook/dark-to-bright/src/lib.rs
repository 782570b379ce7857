//! Dark to bright: the image turns bright within seconds, as at the end of a tunnel, where cameras
//! are overexposed for a moment.
//!
//! There are two thresholds, one for dark and one for bright. Values between them change nothing,
//! so lamps in a tunnel do not count as daylight. It must have been dark for some time, so one dark
//! image does not count as a tunnel.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event, now_ns};

struct DarkToBright {
    light: Light,
}

impl Lambda for DarkToBright {
    fn init(config: &Config) -> Result<Self> {
        let [dark_ns, within_ns] = [config.real("dark_s")?, config.real("within_s")?]
            .map(|seconds| (seconds * 1e9) as i64);
        let (dark, bright) = (config.real("dark_luma")?, config.real("bright_luma")?);
        if bright <= dark {
            let why =
                format!("bright_luma is {bright}; it must be above dark_luma, which is {dark}");
            return Err(Error::new(why));
        }
        Ok(Self { light: Light { dark, bright, dark_ns, within_ns, seen: None } })
    }

    fn on_event(&mut self, camera: Sample) -> Result<()> {
        let luma = camera.as_frame()?.mean_luma(None)?;
        if let Some(Change { from, took_ns }) = self.light.note(now_ns(), luma) {
            event("dark-to-bright", luma - from)
                .with("luma", luma)
                .with("took_s", took_ns as f64 / 1e9)
                .send()?;
        }
        Ok(())
    }
}

struct Light {
    dark: f64,
    bright: f64,
    dark_ns: i64,
    within_ns: i64,
    /// The current dark period; none after a bright image.
    seen: Option<Dark>,
}

/// Times of the first and the last dark image, and the mean grey level of the last.
struct Dark {
    first_ns: i64,
    last_ns: i64,
    luma: f64,
}

#[derive(Debug, PartialEq)]
struct Change {
    from: f64,
    took_ns: i64,
}

impl Light {
    /// Adds an image with this mean grey level, 0 to 255. Returns the change that it completes.
    fn note(&mut self, at_ns: i64, luma: f64) -> Option<Change> {
        if luma < self.dark {
            let first_ns = self.seen.as_ref().map_or(at_ns, |seen| seen.first_ns);
            self.seen = Some(Dark { first_ns, last_ns: at_ns, luma });
        }
        let Dark { first_ns, last_ns, luma: from } = self.seen.take_if(|_| luma > self.bright)?;
        let (lasted_ns, took_ns) = (last_ns - first_ns, at_ns - last_ns);
        // Ignores single dark images, and slow changes such as dawn.
        (lasted_ns >= self.dark_ns && took_ns <= self.within_ns).then_some(Change { from, took_ns })
    }
}

gleaner_sdk::lambda!(DarkToBright);

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    /// Returns the changes in images with these mean grey levels, one per second.
    fn changes(lumas: &[f64]) -> Vec<Change> {
        let mut light =
            Light { dark: 50.0, bright: 80.0, dark_ns: SECOND, within_ns: 3 * SECOND, seen: None };
        (0..).zip(lumas).filter_map(|(second, luma)| light.note(second * SECOND, *luma)).collect()
    }

    #[test]
    fn the_end_of_a_tunnel_is_reported_once() {
        assert_eq!(
            changes(&[120.0, 20.0, 30.0, 60.0, 90.0, 130.0]),
            [Change { from: 30.0, took_ns: 2 * SECOND }]
        );
    }

    #[test]
    fn a_single_dark_image_is_ignored() {
        assert_eq!(changes(&[120.0, 20.0, 120.0]), []);
        assert_eq!(changes(&[120.0, 20.0, 120.0, 20.0, 120.0]), [], "two single ones");
    }

    #[test]
    fn lamps_and_slow_changes_are_ignored() {
        assert_eq!(changes(&[20.0, 70.0, 20.0, 79.0, 30.0]), []);
        assert_eq!(changes(&[40.0, 55.0, 65.0, 75.0, 85.0]), []);
        assert_eq!(changes(&[120.0, 90.0, 60.0, 100.0]), [], "it was never dark");
    }
}
