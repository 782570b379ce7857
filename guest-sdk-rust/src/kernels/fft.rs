//! Computes the power spectral density of signals. Needs the feature `fft`.

use std::f64::consts::TAU;
use std::fmt;
use std::sync::Arc;

use rustfft::num_complex::Complex;
use rustfft::num_traits::Float;
use rustfft::{Fft, FftNum, FftPlanner};

/// Maximum number of samples of one spectrum.
pub const MAX_SAMPLES: usize = 65_536;

/// Complex numbers that one iteration of a loop handles.
const TURN: usize = 8;

/// The type of samples: `f32` or `f64`. `f32` takes half the bytes and time; `f64` has sixteen
/// digits.
pub trait Real: FftNum + Float {}

impl Real for f32 {}
impl Real for f64 {}

/// Computes the power spectral density of signals of one length. Create it once, in `init`.
///
/// For a signal `x` of `n` samples, oldest first, sampled at `rate_hz`, with the periodic Hann
/// window `w[j] = (1 - cos(2 pi j / n)) / 2`:
///
/// ```text
/// density[k] = c[k] |sum over j of w[j] x[j] exp(-2 pi i j k / n)|^2
///              / (rate_hz * sum over j of w[j]^2)
/// ```
///
/// for the bins `k` of 0 to `n / 2`, which lie at `k * rate_hz / n`; `c` is 1 for the first and the
/// last bin and 2 for the others, which also stand for the negative frequencies. The unit is that
/// of the signal, squared, per Hz: (m/s²)²/Hz for an acceleration. The mean is not removed: it is
/// in the first bin and, because of the window, half as much in the second.
///
/// The result is the same bit for bit in every component, and on one machine. A component and a
/// native test differ in the last bits: their sine and cosine come from different libraries.
///
/// ```
/// use gleaner_sdk::kernels::fft::{Spectrum, band_power};
///
/// // A sine of 50 Hz and amplitude 2 has a mean square of 2.
/// let turn = std::f64::consts::TAU;
/// let sine =
///     (0..128).map(|j| 2.0 * (turn * 50.0 * f64::from(j) / 400.0).sin()).collect::<Vec<_>>();
/// let mut spectrum = Spectrum::hann(128, 400.0).unwrap();
/// let mut density = vec![0.0; spectrum.bins()];
/// spectrum.density(&sine, &mut density).unwrap();
/// let power = band_power(&density, spectrum.bin_hz(), 40.0, 60.0);
/// assert!((power - 2.0).abs() < 1e-12);
/// ```
///
/// Source: P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra"
/// (1967), for a single segment.
pub struct Spectrum<T: Real> {
    /// A transform of half the length: two samples are one complex number.
    fft: Arc<dyn Fft<T>>,
    window: Vec<T>,
    /// exp(-2 pi i k / n) for each bin up to the middle.
    turns: Vec<Complex<T>>,
    packed: Vec<Complex<T>>,
    scratch: Vec<Complex<T>>,
    /// Factor for the bins between the first and the last.
    scale: T,
    bin_hz: f64,
}

impl<T: Real> Spectrum<T> {
    /// Prepares for signals of `samples` samples at `rate_hz`, with a Hann window.
    ///
    /// # Errors
    ///
    /// [`SpectrumError::Samples`] unless `samples` is even and from 4 to [`MAX_SAMPLES`];
    /// [`SpectrumError::Rate`] unless `rate_hz` is finite and above 0.
    pub fn hann(samples: usize, rate_hz: f64) -> Result<Self, SpectrumError> {
        if !samples.is_multiple_of(2) || !(4..=MAX_SAMPLES).contains(&samples) {
            return Err(SpectrumError::Samples { samples });
        }
        if !rate_hz.is_finite() || rate_hz <= 0.0 {
            return Err(SpectrumError::Rate { rate_hz });
        }
        let (n, half) = (samples as f64, samples / 2);
        let fft = FftPlanner::new().plan_fft_forward(half);
        let window =
            (0..samples).map(|j| 0.5 - 0.5 * (TAU * j as f64 / n).cos()).collect::<Vec<_>>();
        let turn = |k: usize| {
            let (sine, cosine) = (TAU * k as f64 / n).sin_cos();
            Complex::new(real(cosine), real(-sine))
        };
        // The amplitudes of `untangle` are twice the true ones, and a bin between the first and the
        // last stands for two.
        let energy = window.iter().map(|weight| weight * weight).sum::<f64>();
        Ok(Self {
            window: window.into_iter().map(real).collect(),
            turns: (0..=half / 2).map(turn).collect(),
            packed: vec![Complex::new(T::zero(), T::zero()); half],
            scratch: vec![Complex::new(T::zero(), T::zero()); fft.get_inplace_scratch_len()],
            scale: real(2.0 / (4.0 * rate_hz * energy)),
            bin_hz: rate_hz / n,
            fft,
        })
    }

    /// Returns the number of samples of a signal.
    pub fn samples(&self) -> usize {
        self.window.len()
    }

    /// Returns the number of bins of a density: half the number of samples, plus one.
    pub fn bins(&self) -> usize {
        self.packed.len() + 1
    }

    /// Returns the distance between bins in Hz; bin `k` lies at `k` times this.
    pub fn bin_hz(&self) -> f64 {
        self.bin_hz
    }

    /// Writes the density of `signal`, which has [`samples`](Self::samples) values, oldest first,
    /// to `density`, which has [`bins`](Self::bins) values. Allocates no memory. If the signal has
    /// a NaN or an infinity, bins of the result are NaN.
    ///
    /// # Errors
    ///
    /// [`SpectrumError::Signal`] or [`SpectrumError::Density`] if a length is different.
    pub fn density(&mut self, signal: &[T], density: &mut [T]) -> Result<(), SpectrumError> {
        let (needed, found) = (self.samples(), signal.len());
        if found != needed {
            return Err(SpectrumError::Signal { needed, found });
        }
        let (needed, found) = (self.bins(), density.len());
        if found != needed {
            return Err(SpectrumError::Density { needed, found });
        }
        self.pack(signal);
        self.fft.process_with_scratch(&mut self.packed, &mut self.scratch);
        self.untangle(density);
        Ok(())
    }

    /// Applies the window. Even samples become real parts, odd ones imaginary parts.
    fn pack(&mut self, signal: &[T]) {
        let (signal, window) = (signal.as_chunks::<2>().0, self.window.as_chunks::<2>().0);
        let pair = |[even, odd]: [T; 2], [a, b]: [T; 2]| Complex::new(even * a, odd * b);
        let (packed, packed_rest) = self.packed.as_chunks_mut::<TURN>();
        let ((signal, signal_rest), (window, window_rest)) =
            (signal.as_chunks::<TURN>(), window.as_chunks::<TURN>());
        for ((packed, samples), weights) in packed.iter_mut().zip(signal).zip(window) {
            *packed = std::array::from_fn(|at| pair(samples[at], weights[at]));
        }
        for ((packed, samples), weights) in packed_rest.iter_mut().zip(signal_rest).zip(window_rest)
        {
            *packed = pair(*samples, *weights);
        }
    }

    /// Computes the density of the signal from the transform of the packed signal.
    ///
    /// With Z the former, E = Z[k] + conj(Z[h - k]) is twice the transform of the even samples and
    /// O = -i (Z[k] - conj(Z[h - k])) twice that of the odd ones; E + turns[k] O is then twice that
    /// of the signal at bin k, and E - turns[k] O, conjugated, at h - k.
    fn untangle(&self, density: &mut [T]) {
        let half = self.packed.len();
        let first = self.packed[0];
        // The first and the last bin are real, and stand for one frequency only: half the scale, of
        // the square of twice the sum.
        let two = T::one() + T::one();
        density[0] = two * self.scale * (first.re + first.im) * (first.re + first.im);
        density[half] = two * self.scale * (first.re - first.im) * (first.re - first.im);
        // Bins k and h - k are computed together; the middle bin of an even number is its own
        // partner.
        let scale = self.scale;
        let both = |ahead: Complex<T>, back: Complex<T>, turn: Complex<T>| {
            let (even, odd) = (ahead + back.conj(), ahead - back.conj());
            let odd = Complex::new(odd.im, -odd.re) * turn;
            (scale * (even + odd).norm_sqr(), scale * (even - odd).norm_sqr())
        };
        let pairs = (half - 1) / 2;
        let (low, high) = density[1..half].split_at_mut(pairs);
        let high = &mut high[half - 1 - 2 * pairs..];
        let (low, low_rest) = low.as_chunks_mut::<TURN>();
        let (high_rest, high) = high.as_rchunks_mut::<TURN>();
        let (ahead, ahead_rest) = self.packed[1..=pairs].as_chunks::<TURN>();
        let (back_rest, back) = self.packed[half - pairs..].as_rchunks::<TURN>();
        let (turns, turns_rest) = self.turns[1..=pairs].as_chunks::<TURN>();
        let inputs = ahead.iter().zip(back.iter().rev()).zip(turns);
        for ((low, high), ((ahead, back), turns)) in
            low.iter_mut().zip(high.iter_mut().rev()).zip(inputs)
        {
            for at in 0..TURN {
                (low[at], high[TURN - 1 - at]) = both(ahead[at], back[TURN - 1 - at], turns[at]);
            }
        }
        let inputs = ahead_rest.iter().zip(back_rest.iter().rev()).zip(turns_rest);
        for ((low, high), ((ahead, back), turn)) in
            low_rest.iter_mut().zip(high_rest.iter_mut().rev()).zip(inputs)
        {
            (*low, *high) = both(*ahead, *back, *turn);
        }
        if half.is_multiple_of(2) {
            let middle = self.packed[half / 2];
            density[half / 2] = both(middle, middle, self.turns[half / 2]).0;
        }
    }
}

/// Returns the power between `low_hz` and `high_hz`: the sum of the bins of `density` from `low_hz`
/// (inclusive) to `high_hz` (exclusive), times their distance `bin_hz`. The unit is that of the
/// signal, squared: a sine of amplitude a well inside the band has a² / 2. Adjacent bands share no
/// bin.
///
/// Source: Parseval's theorem.
pub fn band_power<T: Real>(density: &[T], bin_hz: f64, low_hz: f64, high_hz: f64) -> T {
    let within = (0_u32..).zip(density).filter(|(bin, _)| {
        let at_hz = f64::from(*bin) * bin_hz;
        low_hz <= at_hz && at_hz < high_hz
    });
    within.fold(T::zero(), |sum, (_, power)| sum + *power) * real(bin_hz)
}

/// Rounds to the nearest `T`.
fn real<T: Real>(value: f64) -> T {
    T::from_f64(value).expect("f32 and f64 are made from any f64")
}

/// Reason why a spectrum cannot be computed.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum SpectrumError {
    Samples { samples: usize },
    Rate { rate_hz: f64 },
    Signal { needed: usize, found: usize },
    Density { needed: usize, found: usize },
}

impl fmt::Display for SpectrumError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Samples { samples } => {
                write!(
                    f,
                    "a spectrum of {samples} samples; use an even number from 4 to {MAX_SAMPLES}"
                )
            }
            Self::Rate { rate_hz } => {
                write!(f, "a rate of {rate_hz} Hz; it must be finite and above 0")
            }
            Self::Signal { needed, found } => {
                write!(f, "the spectrum is of {needed} samples; the signal has {found}")
            }
            Self::Density { needed, found } => {
                write!(f, "the density has {needed} bins; the output has {found}")
            }
        }
    }
}

impl std::error::Error for SpectrumError {}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(count: usize) -> Vec<f64> {
        let mut state = 3_u32;
        let next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state) / f64::from(u32::MAX) - 0.5
        };
        std::iter::repeat_with(next).take(count).collect()
    }

    /// Computes the density by its definition, term by term.
    fn defined(signal: &[f64], rate_hz: f64) -> Vec<f64> {
        let n = signal.len();
        let window = |j: usize| (std::f64::consts::PI * j as f64 / n as f64).sin().powi(2);
        let energy = (0..n).map(|j| window(j).powi(2)).sum::<f64>();
        let density = |k: usize| {
            let (mut re, mut im) = (0.0, 0.0);
            for (j, x) in signal.iter().enumerate() {
                // The angle stays small, so that its sine is exact.
                let angle = TAU * ((j * k) % n) as f64 / n as f64;
                re += window(j) * x * angle.cos();
                im += window(j) * x * angle.sin();
            }
            let sides = if k == 0 || k == n / 2 { 1.0 } else { 2.0 };
            sides * (re * re + im * im) / (rate_hz * energy)
        };
        (0..=n / 2).map(density).collect()
    }

    fn density<T: Real>(signal: &[T], rate_hz: f64) -> Vec<T> {
        let mut spectrum = Spectrum::hann(signal.len(), rate_hz).unwrap();
        let mut density = vec![T::zero(); spectrum.bins()];
        spectrum.density(signal, &mut density).unwrap();
        density
    }

    #[test]
    fn every_bin_agrees_with_the_definition() {
        for samples in [4, 6, 8, 10, 30, 64, 128, 250, 256, 1000, 1024] {
            let signal = noise(samples);
            let (found, expected) = (density(&signal, 104.0), defined(&signal, 104.0));
            let single = signal.iter().map(|x| *x as f32).collect::<Vec<_>>();
            let single = density(&single, 104.0);
            let largest = expected.iter().copied().fold(0.0, f64::max);
            for (bin, expected) in expected.iter().enumerate() {
                let off = (found[bin] - expected).abs() / largest;
                assert!(
                    off < 1e-13,
                    "{samples} samples, bin {bin}: {} is not {expected}",
                    found[bin]
                );
                let off = (f64::from(single[bin]) - expected).abs() / largest;
                assert!(
                    off < 1e-5,
                    "{samples} samples of f32, bin {bin}: {} is not {expected}",
                    single[bin]
                );
            }
        }
    }

    #[test]
    fn the_power_of_all_bins_is_that_of_the_windowed_signal() {
        let signal = noise(128);
        let power = band_power(&density(&signal, 50.0), 50.0 / 128.0, 0.0, f64::INFINITY);
        let window = |j: usize| (std::f64::consts::PI * j as f64 / 128.0).sin().powi(2);
        let energy = (0..128).map(|j| window(j).powi(2)).sum::<f64>();
        let expected =
            signal.iter().enumerate().map(|(j, x)| (window(j) * x).powi(2)).sum::<f64>() / energy;
        assert!((power / expected - 1.0).abs() < 1e-12, "{power} is not {expected}");
    }

    #[test]
    fn a_bin_belongs_to_one_of_two_adjacent_bands() {
        let flat = [1.0; 9];
        assert_eq!(band_power(&flat, 2.0, 2.0, 6.0), 4.0);
        assert_eq!(band_power(&flat, 2.0, 6.0, 100.0), 12.0);
        assert_eq!(band_power(&flat, 2.0, 6.0, 6.0), 0.0);
    }

    #[test]
    fn a_previous_signal_does_not_change_the_result() {
        let mut spectrum = Spectrum::hann(64, 100.0).unwrap();
        let (mut first, mut second) = ([0.0; 33], [0.0; 33]);
        spectrum.density(&noise(64), &mut first).unwrap();
        spectrum.density(&[f64::NAN; 64], &mut second).unwrap();
        assert!(second.iter().all(|bin| bin.is_nan()));
        spectrum.density(&noise(64), &mut second).unwrap();
        assert_eq!(first, second);
    }

    #[test]
    fn unsupported_sizes_rates_and_lengths_are_refused() {
        let refused = |samples, rate_hz| {
            Spectrum::<f64>::hann(samples, rate_hz).err().map(|error| error.to_string())
        };
        for samples in [0, 2, 63, MAX_SAMPLES + 2] {
            assert!(
                refused(samples, 1.0)
                    .unwrap()
                    .starts_with(&format!("a spectrum of {samples} samples"))
            );
        }
        for rate_hz in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(refused(64, rate_hz).unwrap().starts_with("a rate of "));
        }
        let mut spectrum = Spectrum::hann(64, 1.0).unwrap();
        let error = spectrum.density(&[0.0_f32; 63], &mut [0.0; 33]).unwrap_err();
        assert_eq!(error.to_string(), "the spectrum is of 64 samples; the signal has 63");
        let error = spectrum.density(&[0.0_f32; 64], &mut [0.0; 32]).unwrap_err();
        assert_eq!(error.to_string(), "the density has 33 bins; the output has 32");
    }
}
