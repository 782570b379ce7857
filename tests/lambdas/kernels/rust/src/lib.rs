//! Reports the results of every kernel of the SDK on synthetic pixels and signals: a test calls
//! [`results`] natively and compares.

use gleaner_sdk::data::{Encoding, Roi, encoding_name};
use gleaner_sdk::kernels::fft::{Real, Spectrum, band_power};
use gleaner_sdk::kernels::{Image, downscale, histogram, luma, mean};
use gleaner_sdk::{Config, Lambda, Result, Sample, event};

pub struct KernelResult {
    pub kernel: &'static str,
    /// Digest of all results that are equal on every machine (FNV-1a, 64 bits).
    pub digest: u64,
    /// Floating-point result that may differ in its last bits; else 0.
    pub number: f64,
}

/// Runs each kernel over images of odd sizes, with padding, in every encoding.
pub fn results() -> Result<Vec<KernelResult>> {
    let mut kernels = [
        Digest::of("mean_luma"),
        Digest::of("mean_rgb"),
        Digest::of("to_gray"),
        Digest::of("histogram"),
    ];
    let mut smaller = Digest::of("downscale");
    for (width, height, padding) in [(1, 1, 0), (31, 7, 2), (97, 33, 5), (640, 3, 0), (8400, 2, 1)]
    {
        let bytes = noise((3 * width + padding) * height);
        for encoding in [Encoding::Rgb8, Encoding::Bgr8, Encoding::Mono8] {
            let whole = Image::new(width, height, 3 * width + padding, encoding, &bytes)?;
            let part =
                whole.part(Roi { x: width / 3, y: height / 2, width: width / 2 + 1, height })?;
            for image in [whole, part] {
                let (width, height) = (image.width(), image.height());
                let mut grey = vec![0; (width * height) as usize];
                luma::to_gray(&image, &mut grey)?;
                kernels[0].add(&luma::mean_luma(&image).to_bits().to_le_bytes());
                kernels[1].add(
                    mean::mean_rgb(&image).map(|mean| mean.to_bits().to_le_bytes()).as_flattened(),
                );
                kernels[2].add(&grey);
                kernels[3].add(histogram::histogram(&image).map(u32::to_le_bytes).as_flattened());
                for (width, height) in
                    [(width, height), (width.div_ceil(2), height.div_ceil(2)), (1 + width / 5, 1)]
                {
                    let mut out = vec![0; downscale::downscaled(&image, width, height)?];
                    downscale::downscale(&image, width, height, &mut out)?;
                    smaller.add(encoding_name(encoding).as_bytes());
                    smaller.add(&out);
                }
            }
        }
    }
    let mut results = kernels.into_iter().chain([smaller]).map(Digest::result).collect::<Vec<_>>();
    results.push(signal_mean());
    results.push(KernelResult { kernel: "spectrum_f32", digest: 0, number: spectrum::<f32>()? });
    results.push(KernelResult { kernel: "spectrum_f64", digest: 0, number: spectrum::<f64>()? });
    Ok(results)
}

/// Digest of floating-point sums in a fixed order: equal bits on every machine.
fn signal_mean() -> KernelResult {
    let mut digest = Digest::of("mean");
    for count in [1, 15, 16, 50, 1001] {
        let values = noise(count)
            .into_iter()
            .map(|byte| (f64::from(byte) - 128.0) / 7.0)
            .collect::<Vec<_>>();
        digest.add(&mean::mean(&values).unwrap_or_default().to_bits().to_le_bytes());
    }
    digest.result()
}

/// Sum of the powers of some bands at several lengths.
fn spectrum<T: Real + Into<f64>>() -> Result<f64> {
    let mut sum = 0.0;
    for samples in [6, 64, 100, 128, 1024] {
        let signal = noise(samples).into_iter().filter_map(T::from_u8).collect::<Vec<_>>();
        let mut spectrum = Spectrum::<T>::hann(signal.len(), 100.0)?;
        let mut density = vec![T::zero(); spectrum.bins()];
        spectrum.density(&signal, &mut density)?;
        for (low_hz, high_hz) in [(0.0, 5.0), (5.0, 20.0), (20.0, 51.0)] {
            sum += band_power(&density, spectrum.bin_hz(), low_hz, high_hz).into();
        }
    }
    Ok(sum)
}

/// Pseudo-random bytes, the same in every run.
fn noise(count: u32) -> Vec<u8> {
    let mut state = count;
    let next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    std::iter::repeat_with(next).take(count as usize).collect()
}

struct Digest {
    kernel: &'static str,
    state: u64,
}

impl Digest {
    fn of(kernel: &'static str) -> Self {
        Self { kernel, state: 0xcbf2_9ce4_8422_2325 }
    }

    fn add(&mut self, bytes: &[u8]) {
        let step =
            |state: u64, byte: &u8| (state ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        self.state = bytes.iter().fold(self.state, step);
    }

    fn result(self) -> KernelResult {
        KernelResult { kernel: self.kernel, digest: self.state, number: 0.0 }
    }
}

struct Kernels {
    is_done: bool,
}

impl Lambda for Kernels {
    fn init(_config: &Config) -> Result<Self> {
        Ok(Self { is_done: false })
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        // The results are the same in every wake.
        if std::mem::replace(&mut self.is_done, true) {
            return Ok(());
        }
        for KernelResult { kernel, digest, number } in results()? {
            event(&format!("{kernel} {digest:016x}"), number).send()?;
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(Kernels);
