//! Determines complete windows and computes their roughness. Does not call the host.

use gleaner_sdk::kernels::fft::{Spectrum, SpectrumError, band_power};

/// Number of stamps from which the period is learnt; rule 2.
const LEARN: usize = 33;
/// Minimum and maximum length of a window in samples; rule 3.
const SMALLEST: usize = 16;
const LARGEST: usize = 4096;
/// Longest interval without a gap, in periods; rule 4.
const GAP_PERIODS: f64 = 2.5;
/// Lower and upper edge in Hz, and weight; rule 8.
const BANDS: [(f64, f64, f64); 3] = [(0.5, 2.0, 0.2), (2.0, 8.0, 0.5), (8.0, 20.0, 1.0)];
/// Lowest and highest frequency of the peak in Hz; rule 9.
const PEAK_HZ: (f64, f64) = (1.0, 6.0);

/// State of the rules after the samples so far.
pub struct Road {
    window_s: f64,
    learning: Vec<i64>,
    period_ns: i64,
    last_ns: i64,
    /// Number of samples without a gap, up to the last one.
    run: usize,
    plan: Option<Plan>,
}

/// Buffers and spectrum, created once the length of windows is known.
struct Plan {
    /// Planned for 1 Hz: the rate follows from each window.
    spectrum: Spectrum<f64>,
    density: Vec<f64>,
    centred: Vec<f64>,
}

/// Roughness of one window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Roughness {
    /// Score in (m/s²)².
    pub score: f64,
    /// Frequency of the largest bin in Hz; 0 if there is no bin.
    pub peak_hz: f64,
}

impl Road {
    pub fn new(window_s: f64) -> Self {
        Self {
            window_s,
            learning: Vec::with_capacity(LEARN),
            period_ns: 0,
            last_ns: 0,
            run: 0,
            plan: None,
        }
    }

    /// Adds a sample. Returns the length of the window that it completes, in samples; none if it
    /// completes none.
    pub fn note(&mut self, at_ns: i64) -> Result<Option<usize>, SpectrumError> {
        if self.plan.is_none() {
            self.learn(at_ns)?;
        } else {
            self.go_on(at_ns - self.last_ns);
        }
        self.last_ns = at_ns;
        let Some(plan) = &self.plan else { return Ok(None) };
        let samples = plan.centred.len();
        let is_complete = self.run >= samples && (self.run - samples).is_multiple_of(samples / 4);
        Ok(is_complete.then_some(samples))
    }

    /// Applies rules 2 to 4 to the first samples.
    fn learn(&mut self, at_ns: i64) -> Result<(), SpectrumError> {
        if self.learning.last().is_some_and(|last| at_ns <= *last) {
            self.learning.clear();
        }
        self.learning.push(at_ns);
        if self.learning.len() < LEARN {
            return Ok(());
        }
        let intervals: Vec<i64> =
            self.learning.array_windows().map(|[earlier, later]| later - earlier).collect();
        let mut sorted = intervals.clone();
        sorted.sort_unstable();
        self.period_ns = sorted[sorted.len() / 2];
        self.run = 1;
        intervals.into_iter().for_each(|interval| self.go_on(interval));
        let samples = nearest_power_of_two(self.window_s * 1e9 / self.period_ns as f64);
        let spectrum = Spectrum::hann(samples, 1.0)?;
        self.plan = Some(Plan {
            density: vec![0.0; spectrum.bins()],
            centred: vec![0.0; samples],
            spectrum,
        });
        self.learning = Vec::new();
        Ok(())
    }

    fn go_on(&mut self, interval_ns: i64) {
        let follows = interval_ns > 0 && interval_ns as f64 <= GAP_PERIODS * self.period_ns as f64;
        self.run = if follows { self.run + 1 } else { 1 };
    }

    /// Computes the roughness of the window that was just completed, from its stamps in nanoseconds
    /// and its vertical accelerations in m/s², oldest first.
    pub fn roughness(&mut self, at_ns: &[i64], signal: &[f64]) -> Result<Roughness, SpectrumError> {
        let none = Roughness { score: 0.0, peak_hz: 0.0 };
        let (Some(plan), [first, .., last], [start, ..]) = (&mut self.plan, at_ns, signal) else {
            return Ok(none);
        };
        let samples = signal.len() as f64;
        let rate_hz = (samples - 1.0) * 1e9 / (last - first) as f64;
        let bin_hz = rate_hz / samples;
        plan.centred.clear();
        plan.centred.extend(signal.iter().map(|value| value - start));
        let mean = plan.centred.iter().sum::<f64>() / samples;
        plan.centred.iter_mut().for_each(|value| *value -= mean);
        plan.spectrum.density(&plan.centred, &mut plan.density)?;
        plan.density.iter_mut().for_each(|power| *power /= rate_hz);
        let in_band = |(low, high, weight): (f64, f64, f64)| {
            weight * band_power(&plan.density, bin_hz, low, high)
        };
        Ok(Roughness {
            score: BANDS.map(in_band).iter().sum(),
            peak_hz: peak(&plan.density, bin_hz),
        })
    }
}

/// Returns the frequency of the largest bin within [`PEAK_HZ`], the lowest of equal ones.
fn peak(density: &[f64], bin_hz: f64) -> f64 {
    let bins = density.iter().enumerate().map(|(bin, power)| (bin as f64 * bin_hz, *power));
    let within = bins.filter(|(at_hz, _)| (PEAK_HZ.0..=PEAK_HZ.1).contains(at_hz));
    within
        .reduce(|largest, next| if next.1 > largest.1 { next } else { largest })
        .map_or(0.0, |(at_hz, _)| at_hz)
}

/// Returns the power of two nearest to `wanted`; the larger one if two are equally near.
fn nearest_power_of_two(wanted: f64) -> usize {
    let mut samples = SMALLEST;
    while samples < LARGEST && wanted >= 1.5 * samples as f64 {
        samples *= 2;
    }
    samples
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;
    use std::path::Path;
    use std::{env, fs};

    use super::*;

    /// Returns the index of the last sample of each window, and its roughness. The sampling rate is
    /// `rate_hz`.
    fn windows(road: &mut Road, rate_hz: f64, signal: &[f64]) -> Vec<(usize, Roughness)> {
        let at_ns: Vec<i64> =
            (0..signal.len()).map(|i| (i as f64 / rate_hz * 1e9).round() as i64).collect();
        let mut found = Vec::new();
        for end in 0..signal.len() {
            if let Some(samples) = road.note(at_ns[end]).unwrap() {
                let window = end + 1 - samples..=end;
                found.push((end, road.roughness(&at_ns[window.clone()], &signal[window]).unwrap()));
            }
        }
        found
    }

    fn sine(hz: f64, amplitude: f64, samples: usize) -> Vec<f64> {
        (0..samples).map(|i| 9.81 + amplitude * (TAU * hz * i as f64 / 50.0).sin()).collect()
    }

    #[test]
    fn a_window_of_a_second_and_a_quarter_has_64_samples_at_50_hz_and_128_at_104() {
        for (rate_hz, samples) in [(50.0, 64), (104.0, 128)] {
            let found = windows(&mut Road::new(1.25), rate_hz, &vec![9.81; 2 * samples]);
            let ends: Vec<usize> = found.iter().map(|(end, _)| *end).collect();
            assert_eq!(ends, (0..5).map(|hop| samples - 1 + hop * samples / 4).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_sine_scores_its_mean_square_by_the_weight_of_its_band() {
        for (hz, weight) in [(1.171_875, 0.2), (4.687_5, 0.5), (12.5, 1.0), (23.437_5, 0.0)] {
            for (end, found) in windows(&mut Road::new(5.0), 50.0, &sine(hz, 3.0, 600)) {
                assert!((found.score - weight * 4.5).abs() < 0.01, "{hz} Hz at {end}: {found:?}");
                assert!(
                    (found.peak_hz - hz).abs() < 1e-9 || hz > PEAK_HZ.1,
                    "{hz} Hz at {end}: {found:?}"
                );
            }
        }
    }

    #[test]
    fn a_constant_scores_exactly_zero() {
        for constant in [9.81, 9.7] {
            let found = windows(&mut Road::new(1.25), 50.0, &[constant; 200]);
            let scores: Vec<f64> = found.iter().map(|(_, found)| found.score).collect();
            assert_eq!(scores, [0.0; 9]);
        }
    }

    #[test]
    fn of_two_equally_near_lengths_the_larger_one_is_used() {
        let lengths = [0.0, 23.9, 24.0, 47.9, 48.0, 1e9].map(nearest_power_of_two);
        assert_eq!(lengths, [16, 16, 32, 32, 64, 4096]);
    }

    #[test]
    fn the_score_of_nan_is_nan() {
        let found = windows(&mut Road::new(1.25), 50.0, &[f64::NAN; 100]);
        assert!(
            !found.is_empty() && found.iter().all(|(_, found)| found.score.is_nan()),
            "{found:?}"
        );
    }

    /// Uses 300 series of the vertical acceleration at 50 Hz: regular road and four kinds of bad
    /// road. The data cannot be distributed with the project.
    #[test]
    fn regular_roads_score_lower_than_others() {
        let name = "data/road_surface/accz_50hz_labelled.csv";
        let folder = env::var_os("GLEANER_SHARED").unwrap_or_default();
        let Ok(text) = fs::read_to_string(Path::new(&folder).join(name)) else {
            return println!("skipped: set GLEANER_SHARED to the folder that has {name}");
        };
        let (mut regular, mut others) = (Vec::new(), Vec::new());
        for line in text.lines().skip(1) {
            let [_, label, values] = line.split(',').collect::<Vec<_>>()[..] else {
                panic!("three columns")
            };
            let signal: Vec<f64> = values.split(';').map(|value| value.parse().unwrap()).collect();
            let found = windows(&mut Road::new(1.25), 50.0, &signal);
            let score = found.iter().map(|(_, found)| found.score).fold(0.0, f64::max);
            if label == "regular_road" { &mut regular } else { &mut others }.push(score);
        }
        assert_eq!((regular.len(), others.len()), (60, 240));
        let above = others
            .iter()
            .map(|other| regular.iter().filter(|score| other > *score).count())
            .sum::<usize>();
        let area = above as f64 / (regular.len() * others.len()) as f64;
        println!("area under the curve: {area:.3}");
        assert!(area >= 0.80, "{area}");
    }
}
