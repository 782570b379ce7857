//! Conversion of frames to input tensors.

use std::mem;

use gleaner_rules::pixels::{StopCheck, View};

use crate::vision::bilinear::{Bilinear, PixelOrder};
use crate::vision::error::VisionError;
use crate::vision::placement::{Area, MAX_TENSOR_SIDE, Placed, Placement};

/// Conversion of a frame to the input tensor of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Preprocess {
    /// Width of the tensor in pixels, 1 to [`MAX_TENSOR_SIDE`].
    pub width: u32,
    /// Height of the tensor in pixels, 1 to [`MAX_TENSOR_SIDE`].
    pub height: u32,
    pub placement: Placement,
    /// Grey level of the border.
    pub fill: u8,
    /// Channel order of the tensor: true for blue first, false for red first.
    pub bgr: bool,
    /// True for shape [1, height, width, 3], false for [1, 3, height, width].
    pub channels_last: bool,
    /// True for bytes from 0 to 255, without the numbers below; false for 32-bit floats.
    pub bytes: bool,
    /// Each channel becomes `(value * scale - mean) / deviation`, with `value` from 0 to 255.
    pub scale: f32,
    /// Mean of each channel, in the order of the tensor.
    pub mean: [f32; 3],
    /// Deviation of each channel, in the order of the tensor; not 0.
    pub deviation: [f32; 3],
}

impl Preprocess {
    /// Checks all numbers.
    ///
    /// # Errors
    ///
    /// [`VisionError::TensorSize`] and [`VisionError::Normalisation`].
    pub fn check(&self) -> Result<(), VisionError> {
        let fits = |side| (1..=MAX_TENSOR_SIDE).contains(&side);
        if !fits(self.width) || !fits(self.height) {
            return Err(VisionError::TensorSize { width: self.width, height: self.height });
        }
        if self.bytes {
            return Ok(());
        }
        let refused = |name, value| Err(VisionError::Normalisation { name, value });
        if !self.scale.is_finite() {
            return refused("scale", self.scale);
        }
        if let Some(mean) = self.mean.iter().find(|mean| !mean.is_finite()) {
            return refused("mean", *mean);
        }
        let bad = |deviation: &&f32| !deviation.is_finite() || **deviation == 0.0;
        if let Some(deviation) = self.deviation.iter().find(bad) {
            return refused("deviation", *deviation);
        }
        Ok(())
    }

    pub fn shape(&self) -> [u32; 4] {
        if self.channels_last {
            [1, self.height, self.width, 3]
        } else {
            [1, 3, self.height, self.width]
        }
    }

    /// Returns the size of the tensor in bytes, at most 768 MiB. Fails as [`Preprocess::check`].
    pub fn size(&self) -> Result<usize, VisionError> {
        self.check()?;
        let element = if self.bytes { 1 } else { mem::size_of::<f32>() };
        Ok(self.width as usize * self.height as usize * 3 * element)
    }

    fn element(&self, channel: usize, level: u8) -> f32 {
        // A level fits exactly.
        (f32::from(level) * self.scale - self.mean[channel]) / self.deviation[channel]
    }
}

/// Converts frames to tensors. It keeps its buffers, so that a frame of a known size allocates
/// nothing.
#[derive(Debug, Default)]
pub struct Preparer {
    bilinear: Bilinear,
}

impl Preparer {
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes the tensor of `view` to `out`, whose length becomes [`Preprocess::size`], and returns
    /// the place of the frame. Floats are little-endian.
    ///
    /// Pixels are blended bilinearly, as by `INTER_LINEAR` of OpenCV. Alpha is ignored, grey is
    /// repeated in three channels, and yuv422 is assumed to be BT.601 of full range. The stop check
    /// of `view` is not called; see [`Preparer::prepare_into`].
    ///
    /// # Errors
    ///
    /// As for [`Preprocess::check`], and [`VisionError::Encoding`].
    pub fn prepare(
        &mut self,
        view: &View<'_>,
        how: &Preprocess,
        out: &mut Vec<u8>,
    ) -> Result<Placed, VisionError> {
        let size = how.size()?;
        // The frame is refused before memory is taken.
        PixelOrder::of(view.encoding())?;
        out.resize(size, 0);
        self.prepare_into(view, how, None, out)
    }

    /// As [`Preparer::prepare`], into memory of exactly [`Preprocess::size`] bytes, such as a
    /// region that is shared, for a caller that may want to stop it. After an error the content of
    /// `out` is undefined.
    ///
    /// # Errors
    ///
    /// As for [`Preparer::prepare`], [`VisionError::TensorLength`], and
    /// [`VisionError::Pixels`] if `stop_check` ends it.
    pub fn prepare_into(
        &mut self,
        view: &View<'_>,
        how: &Preprocess,
        stop_check: Option<&StopCheck<'_>>,
        out: &mut [u8],
    ) -> Result<Placed, VisionError> {
        let needed = how.size()?;
        if out.len() != needed {
            return Err(VisionError::TensorLength { needed, found: out.len() });
        }
        let frame = (view.width(), view.height());
        let (area, placed) = how.placement.place(frame, (how.width, how.height));
        if how.bytes {
            self.fill::<1>(view, how, area, |_, level| [level], stop_check, out)?;
        } else {
            let element = |channel, level| how.element(channel, level).to_le_bytes();
            self.fill::<4>(view, how, area, element, stop_check, out)?;
        }
        Ok(placed)
    }

    /// Writes all elements; `element` returns that of a level in a channel.
    fn fill<const BYTES: usize>(
        &mut self,
        view: &View<'_>,
        how: &Preprocess,
        area: Area,
        element: impl Fn(usize, u8) -> [u8; BYTES],
        stop_check: Option<&StopCheck<'_>>,
        out: &mut [u8],
    ) -> Result<(), VisionError> {
        let mut resize = self.bilinear.begin(view, (area.width, area.height), how.bgr)?;
        let places = resize.channels();
        let border = [0, 1, 2].map(|channel| element(channel, how.fill));
        let (width, plane) = (how.width as usize, how.width as usize * how.height as usize);
        let inside = (area.left as usize, (area.left + area.width) as usize);
        // Two rows are read and one is written; without the factor, a row of one pixel is free.
        let work = 2 * view.row(0).len() + 3 * BYTES * width;
        let (out, _) = out.as_chunks_mut::<BYTES>();
        for y in 0..how.height {
            if let Some(stop_check) = stop_check {
                stop_check.check(work)?;
            }
            let row = y as usize * width;
            let pixels = y.checked_sub(area.top).filter(|y| *y < area.height);
            let pixels = pixels.map(|y| resize.row(y));
            if how.channels_last {
                let (line, _) = out[3 * row..3 * (row + width)].as_chunks_mut::<3>();
                fill_line(line, inside, border, pixels, |pixel| {
                    [0, 1, 2].map(|channel| element(channel, pixel[places[channel]]))
                });
                continue;
            }
            for (channel, border) in border.into_iter().enumerate() {
                let start = channel * plane + row;
                let shift = 8 * places[channel];
                // A shift instead of an index: CPUs do four pixels at once.
                fill_line(&mut out[start..start + width], inside, border, pixels, |pixel| {
                    element(channel, (u32::from_le_bytes(pixel) >> shift) as u8)
                });
            }
        }
        Ok(())
    }
}

/// Fills a line with border, and its range `inside` with the converted `pixels`, if there are any.
fn fill_line<T: Copy>(
    line: &mut [T],
    (left, right): (usize, usize),
    border: T,
    pixels: Option<&[[u8; 4]]>,
    convert: impl Fn([u8; 4]) -> T,
) {
    let Some(pixels) = pixels else {
        line.fill(border);
        return;
    };
    line[..left].fill(border);
    line[right..].fill(border);
    for (value, pixel) in line[left..right].iter_mut().zip(pixels) {
        *value = convert(*pixel);
    }
}
