//! Pothole: one hard jolt in the vertical acceleration, far above the usual roughness of the road.
//!
//! Most wakes only compute the span of the last 0.15 s. The roughness of the road over the last two
//! seconds is computed only when a jolt has ended.

use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input, now_ns};

const JOLT_NS: i64 = 150_000_000;
const ROAD_NS: i64 = 2_000_000_000;

struct Pothole {
    imu: Topic,
    vertical: Field,
    times_usual: f64,
    jolts: Jolts,
}

impl Lambda for Pothole {
    fn init(config: &Config) -> Result<Self> {
        let imu = input("imu")?;
        let vertical = imu.field("linear_acceleration.z")?;
        let jolts = Jolts { limit: config.real("jolt_mps2")?, largest: None };
        Ok(Self { imu, vertical, times_usual: config.real("times_usual")?, jolts })
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        let now = now_ns();
        let newest = self.imu.column_since(&self.vertical, now - JOLT_NS)?;
        let Some(jolt) = self.jolts.note(span(&newest.values)) else { return Ok(()) };
        let usual = spread(self.imu.column_since(&self.vertical, now - ROAD_NS)?.values);
        if jolt >= self.times_usual * usual {
            event("pothole", jolt).with("usual_mps2", usual).send()?;
        }
        Ok(())
    }
}

/// Detects jolts. A jolt begins at the limit and ends below half of it, so that one jolt is one
/// event, with its largest span.
struct Jolts {
    limit: f64,
    largest: Option<f64>,
}

impl Jolts {
    /// Adds a span. Returns the largest span of the jolt that it ends; none if it ends none.
    fn note(&mut self, span: f64) -> Option<f64> {
        match self.largest {
            Some(_) if span < self.limit / 2.0 => self.largest.take(),
            Some(largest) => {
                self.largest = Some(largest.max(span));
                None
            }
            None => {
                self.largest = (span >= self.limit).then_some(span);
                None
            }
        }
    }
}

/// Returns the largest minus the smallest value, in their unit; minus infinity if there are none.
fn span(values: &[f64]) -> f64 {
    let (low, high) = values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
    high - low
}

/// Returns the median absolute deviation from the median. Unlike a standard deviation, it hardly
/// changes with a jolt of a few samples.
fn spread(values: Vec<f64>) -> f64 {
    let centre = median(values.clone());
    median(values.into_iter().map(|value| (value - centre).abs()).collect())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

gleaner_sdk::lambda!(Pothole);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jolt_is_reported_once_at_its_end_with_its_largest_value() {
        let mut jolts = Jolts { limit: 8.0, largest: None };
        let reported =
            [1.0, 7.9, 8.0, 11.0, 9.0, 4.0, 3.9, 1.0, 8.5, 1.0].map(|span| jolts.note(span));
        let mut expected = [None; 10];
        (expected[6], expected[9]) = (Some(11.0), Some(8.5));
        assert_eq!(reported, expected);
    }

    #[test]
    fn the_spread_of_a_road_hardly_changes_with_a_jolt() {
        let road: Vec<f64> =
            (0..100).map(|i| 9.7 + if i % 2 == 0 { 0.25 } else { -0.25 }).collect();
        let mut jolted = road.clone();
        jolted[50..55].copy_from_slice(&[3.0, 15.0, 4.0, 14.0, 9.0]);
        assert!((spread(road) - spread(jolted)).abs() <= 0.5);
        assert_eq!((spread(Vec::new()), span(&[3.0, -1.0, 2.0])), (0.0, 4.0));
    }
}
