//! Repeats one kind of work, as many rounds as its caller requests. The bench also calls [`Work`]
//! natively.

use std::hint::black_box;

use gleaner_sdk::data::Encoding;
use gleaner_sdk::kernels::fft::{Real, Spectrum};
use gleaner_sdk::kernels::{Image, downscale, histogram, luma, mean};
use gleaner_sdk::{
    Config, Error, Field, Frame, Lambda, Result, Sample, Tick, Topic, input, now_ns,
};

const WIDTH: u32 = 1920;
const HEIGHT: u32 = 1080;

/// Bytes of a piece of a frame.
const PIECE: u32 = 64 << 10;

/// Samples of a column.
const COLUMN: u32 = 256;

/// One kernel with its input and the buffer for its output.
pub enum Work {
    /// Density of a signal of `f32`.
    Single(Density<f32>),
    /// Density of a signal of `f64`.
    Double(Density<f64>),
    /// A kernel over an image of 1920x1080 bgr8.
    Pixels {
        /// Width * height * 3 bytes.
        bgr: Vec<u8>,
        /// The kernel; it may use the buffer for its result.
        kernel: fn(&Image<'_>, &mut [u8]) -> Result<f64>,
        /// A buffer as large as the largest result.
        out: Vec<u8>,
    },
    /// Mean of 65,536 numbers.
    Mean(Vec<f64>),
}

/// A plan, a signal and the buffer for its density.
pub struct Density<T: Real> {
    plan: Spectrum<T>,
    signal: Vec<T>,
    density: Vec<T>,
}

impl<T: Real + Into<f64>> Density<T> {
    fn new(samples: usize) -> Result<Self> {
        let plan = Spectrum::hann(samples, 1000.0)?;
        let density = vec![T::zero(); plan.bins()];
        Ok(Self {
            plan,
            signal: noise(samples).into_iter().filter_map(T::from_u8).collect(),
            density,
        })
    }

    fn round(&mut self) -> Result<f64> {
        self.plan.density(black_box(&self.signal), &mut self.density)?;
        Ok(self.density[1].into())
    }
}

impl Work {
    /// The work with the name `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub fn new(name: &str) -> Result<Self> {
        let pixels = |kernel| {
            let bgr = noise((WIDTH * HEIGHT * 3) as usize);
            Ok(Self::Pixels { bgr, kernel, out: vec![0; (WIDTH * HEIGHT) as usize] })
        };
        match name {
            "spectrum-256-f32" => Ok(Self::Single(Density::new(256)?)),
            "spectrum-1024-f32" => Ok(Self::Single(Density::new(1024)?)),
            "spectrum-256-f64" => Ok(Self::Double(Density::new(256)?)),
            "spectrum-1024-f64" => Ok(Self::Double(Density::new(1024)?)),
            "luma" => pixels(|image, _| Ok(luma::mean_luma(image))),
            "gray" => pixels(|image, out| {
                luma::to_gray(image, out)?;
                Ok(f64::from(out[out.len() / 2]))
            }),
            "histogram" => pixels(|image, _| Ok(f64::from(histogram::histogram(image)[99]))),
            "downscale" => pixels(|image, out| {
                let out = &mut out[..640 * 360 * 3];
                downscale::downscale(image, 640, 360, out)?;
                Ok(f64::from(out[out.len() / 2]))
            }),
            "mean" => Ok(Self::Mean(noise(1 << 16).into_iter().map(f64::from).collect())),
            _ => Err(Error::new(format!("unknown work `{name}`"))),
        }
    }

    /// Does the work once; the returned number depends on the result.
    ///
    /// # Errors
    ///
    /// Only if a kernel has a defect.
    pub fn round(&mut self) -> Result<f64> {
        match self {
            Self::Single(density) => density.round(),
            Self::Double(density) => density.round(),
            Self::Pixels { bgr, kernel, out } => {
                let image = Image::new(WIDTH, HEIGHT, WIDTH * 3, Encoding::Bgr8, black_box(bgr))?;
                kernel(&image, out)
            }
            Self::Mean(values) => Ok(mean::mean(black_box(values)).unwrap_or_default()),
        }
    }

    /// Does the work `rounds` times; returns the last number.
    ///
    /// # Errors
    ///
    /// As [`round`](Self::round).
    pub fn rounds(&mut self, rounds: u64) -> Result<f64> {
        (0..rounds).try_fold(0.0, |_, _| self.round().map(black_box))
    }
}

/// Pseudo-random bytes, the same in every run.
fn noise(count: usize) -> Vec<u8> {
    let mut state = 1_u32;
    let next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    std::iter::repeat_with(next).take(count).collect()
}

struct Kernels {
    work: Requested,
    rounds: i64,
    pixels: Vec<u8>,
}

/// The work of a lambda.
enum Requested {
    /// Work without a host, in a tick.
    Alone(Work),
    /// Work with the host, in a wake by a frame.
    Hosted(HostWork),
}

enum HostWork {
    /// Makes the smallest host call.
    Call,
    /// Reads a field of the newest samples.
    Column(Topic, Field),
    /// Has the host compute the mean luma.
    Luma,
    /// Reads all pixels in pieces, without storing them.
    Stream,
    /// Copies all pixels into one buffer.
    Copy,
    /// Does that, and computes their mean luma.
    CopyLuma,
}

impl HostWork {
    fn new(name: &str) -> Result<Option<Self>> {
        Ok(Some(match name {
            "call" => Self::Call,
            "column" => {
                let imu = input("imu")?;
                let field = imu.field("linear_acceleration.x")?;
                Self::Column(imu, field)
            }
            "luma-by-host" => Self::Luma,
            "stream" => Self::Stream,
            "copy" => Self::Copy,
            "copy-luma" => Self::CopyLuma,
            _ => return Ok(None),
        }))
    }
}

impl Lambda for Kernels {
    fn init(config: &Config) -> Result<Self> {
        let name = config.text("work")?;
        let work = match HostWork::new(name)? {
            Some(work) => Requested::Hosted(work),
            None => Requested::Alone(Work::new(name)?),
        };
        Ok(Self { work, rounds: config.integer("rounds")?, pixels: Vec::new() })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let Requested::Hosted(work) = &self.work else {
            return Err(Error::new("this work needs no host"));
        };
        let frame = sample.as_frame()?;
        let info = frame.info();
        let pixels = &mut self.pixels;
        for _ in 0..self.rounds {
            match work {
                HostWork::Call => {
                    black_box(now_ns());
                }
                HostWork::Column(imu, field) => drop(black_box(imu.column(field, COLUMN)?)),
                HostWork::Luma => {
                    black_box(frame.mean_luma(None)?);
                }
                HostWork::Stream => (0..info.size)
                    .step_by(PIECE as usize)
                    .for_each(|offset| drop(black_box(frame.read(offset, PIECE)))),
                HostWork::Copy => copy(&frame, pixels)?,
                HostWork::CopyLuma => {
                    copy(&frame, pixels)?;
                    let step = info.width * 3;
                    let image = Image::new(info.width, info.height, step, info.encoding, pixels)?;
                    black_box(luma::mean_luma(&image));
                }
            }
        }
        Ok(())
    }

    /// Does work without a host: `missed` rounds. The result is returned as an error, the only text
    /// that a wake returns.
    fn on_tick(&mut self, tick: Tick) -> Result<()> {
        if tick.missed == 0 {
            return Ok(());
        }
        let Requested::Alone(work) = &mut self.work else {
            return Err(Error::new("this work needs a host"));
        };
        Err(Error::new(work.rounds(tick.missed)?.to_string()))
    }
}

fn copy(frame: &Frame, pixels: &mut Vec<u8>) -> Result<()> {
    pixels.resize(frame.info().size as usize, 0);
    frame.copy_to(black_box(pixels))
}

gleaner_sdk::lambda!(Kernels);
