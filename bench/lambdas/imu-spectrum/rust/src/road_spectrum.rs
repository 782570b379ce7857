//! Computes the score of a window. Does not call the host.

use gleaner_sdk::kernels::fft::{Spectrum, SpectrumError, band_power};

/// Number of samples of a window; rule 1.
pub const SAMPLES: usize = 256;
/// Sampling rate in Hz; rule 2.
const RATE_HZ: f64 = 100.0;
/// Lower and upper edge in Hz, and weight; rule 5.
const BANDS: [(f64, f64, f64); 4] =
    [(0.5, 2.0, 0.2), (2.0, 8.0, 0.5), (8.0, 20.0, 1.0), (20.0, 45.0, 0.5)];

/// Plan and buffers of the spectrum of a window.
pub struct RoadSpectrum {
    spectrum: Spectrum<f64>,
    density: Vec<f64>,
    centred: Vec<f64>,
}

impl RoadSpectrum {
    pub fn new() -> Result<Self, SpectrumError> {
        let spectrum = Spectrum::hann(SAMPLES, RATE_HZ)?;
        let density = vec![0.0; spectrum.bins()];
        Ok(Self { spectrum, density, centred: Vec::with_capacity(SAMPLES) })
    }

    /// Returns the score in (m/s²)² of [`SAMPLES`] vertical accelerations in m/s², oldest first.
    ///
    /// # Errors
    ///
    /// [`SpectrumError::Signal`] for another number of samples.
    pub fn score(&mut self, signal: &[f64]) -> Result<f64, SpectrumError> {
        let start = signal.first().copied().unwrap_or_default();
        self.centred.clear();
        self.centred.extend(signal.iter().map(|value| value - start));
        let mean = self.centred.iter().sum::<f64>() / signal.len() as f64;
        self.centred.iter_mut().for_each(|value| *value -= mean);
        self.spectrum.density(&self.centred, &mut self.density)?;
        let bin_hz = self.spectrum.bin_hz();
        let weighted = |(low, high, weight)| weight * band_power(&self.density, bin_hz, low, high);
        Ok(BANDS.map(weighted).iter().sum())
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    fn score(signal: &[f64]) -> f64 {
        RoadSpectrum::new().unwrap().score(signal).unwrap()
    }

    #[test]
    fn a_sine_scores_its_mean_square_by_the_weight_of_its_band() {
        // The window spreads a sine at a bin over its two neighbours, which are in the same band.
        for (bin, weight) in [(3, 0.2), (12, 0.5), (32, 1.0), (80, 0.5), (118, 0.0)] {
            let sine = |j| 9.81 + 3.0 * (TAU * f64::from(bin * j) / 256.0).sin();
            let found = score(&(0..256).map(sine).collect::<Vec<_>>());
            assert!((found - weight * 4.5).abs() < 1e-12, "bin {bin}: {found}");
        }
    }

    #[test]
    fn a_constant_scores_exactly_zero() {
        assert_eq!([9.81, 9.7].map(|constant| score(&[constant; SAMPLES])), [0.0; 2]);
    }

    #[test]
    fn the_score_of_nan_is_nan() {
        assert!(score(&[f64::NAN; SAMPLES]).is_nan());
    }

    #[test]
    fn a_window_of_another_length_is_refused() {
        for found in [0, 255, 257] {
            let refused = RoadSpectrum::new().unwrap().score(&vec![9.81; found]);
            assert_eq!(refused, Err(SpectrumError::Signal { needed: 256, found }));
        }
    }
}
