//! Dark to bright: the picture turns bright within seconds, as at the end of a tunnel. There
//! cameras are blind for a moment.
//!
//! Two limits, one for dark and one for bright: what lies between changes nothing, so that lamps in
//! a tunnel are no daylight. And one dark picture is no tunnel: it must have been dark for a time.

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
                format!("bright_luma is {bright}; it has to be above dark_luma, which is {dark}");
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
    /// None once it was bright.
    seen: Option<Dark>,
}

/// When the first and the last dark picture were, and the mean grey of the last.
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
    /// The change that a picture of this mean grey, 0 to 255, completes.
    fn note(&mut self, at_ns: i64, luma: f64) -> Option<Change> {
        if luma < self.dark {
            let first_ns = self.seen.as_ref().map_or(at_ns, |seen| seen.first_ns);
            self.seen = Some(Dark { first_ns, last_ns: at_ns, luma });
        }
        let Dark { first_ns, last_ns, luma: from } = self.seen.take_if(|_| luma > self.bright)?;
        let (lasted_ns, took_ns) = (last_ns - first_ns, at_ns - last_ns);
        // A dark picture alone is no tunnel, and a dawn is no event.
        (lasted_ns >= self.dark_ns && took_ns <= self.within_ns).then_some(Change { from, took_ns })
    }
}

gleaner_sdk::lambda!(DarkToBright);

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    /// The changes in pictures of these mean greys, one a second.
    fn changes(lumas: &[f64]) -> Vec<Change> {
        let mut light =
            Light { dark: 50.0, bright: 80.0, dark_ns: SECOND, within_ns: 3 * SECOND, seen: None };
        (0..).zip(lumas).filter_map(|(second, luma)| light.note(second * SECOND, *luma)).collect()
    }

    #[test]
    fn the_end_of_a_tunnel_is_told_once() {
        assert_eq!(
            changes(&[120.0, 20.0, 30.0, 60.0, 90.0, 130.0]),
            [Change { from: 30.0, took_ns: 2 * SECOND }]
        );
    }

    #[test]
    fn a_dark_picture_alone_is_no_tunnel() {
        assert_eq!(changes(&[120.0, 20.0, 120.0]), []);
        assert_eq!(
            changes(&[120.0, 20.0, 120.0, 20.0, 120.0]),
            [],
            "nor are two with light between them"
        );
    }

    #[test]
    fn lamps_and_a_dawn_are_no_change() {
        assert_eq!(changes(&[20.0, 70.0, 20.0, 79.0, 30.0]), []);
        assert_eq!(changes(&[40.0, 55.0, 65.0, 75.0, 85.0]), []);
        assert_eq!(changes(&[120.0, 90.0, 60.0, 100.0]), [], "it was never dark");
    }
}
