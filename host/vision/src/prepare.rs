//! Conversion of frames to input tensors.

use std::mem;

use gleaner_rules::pixels::{StopCheck, View};

use crate::bilinear::{Bilinear, PixelOrder};
use crate::error::VisionError;
use crate::placement::{Area, Placed, Placement};

/// Largest width and height of a tensor, in pixels.
pub const MAX_TENSOR_SIDE: u32 = 8192;

/// Conversion of a frame to the input tensor of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Preprocess {
    /// Width of the tensor in pixels, 1 to [`MAX_TENSOR_SIDE`].
    pub width: u32,
    /// Height of the tensor in pixels, 1 to [`MAX_TENSOR_SIDE`].
    pub height: u32,
    /// Place of the frame in the tensor.
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

    /// Returns the shape of the tensor.
    pub fn shape(&self) -> [u32; 4] {
        if self.channels_last {
            [1, self.height, self.width, 3]
        } else {
            [1, 3, self.height, self.width]
        }
    }

    /// Returns the size of the tensor in bytes, at most 768 MiB.
    ///
    /// # Errors
    ///
    /// As for [`Preprocess::check`].
    pub fn size(&self) -> Result<usize, VisionError> {
        self.check()?;
        let element = if self.bytes { 1 } else { mem::size_of::<f32>() };
        Ok(self.width as usize * self.height as usize * 3 * element)
    }

    /// Returns the element of each level in channel `channel`.
    fn elements<const BYTES: usize>(
        &self,
        channel: usize,
        encode: impl Fn(f32) -> [u8; BYTES],
    ) -> [[u8; BYTES]; 256] {
        let (mean, deviation) = (self.mean[channel], self.deviation[channel]);
        // A level fits exactly.
        std::array::from_fn(|level| encode((level as f32 * self.scale - mean) / deviation))
    }
}

/// Converts frames to tensors. It keeps its buffers, so that a frame of a known size allocates
/// nothing.
#[derive(Debug, Default)]
pub struct Preparer {
    bilinear: Bilinear,
}

impl Preparer {
    /// Creates a preparer without buffers.
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
            let element = |level: usize| [level as u8];
            let elements = [std::array::from_fn(element); 3];
            self.fill::<1>(view, how, area, &elements, stop_check, out)?;
        } else {
            let elements = [0, 1, 2].map(|channel| how.elements(channel, f32::to_le_bytes));
            self.fill::<4>(view, how, area, &elements, stop_check, out)?;
        }
        Ok(placed)
    }

    /// Writes all elements; `elements` has that of each level, for each channel.
    fn fill<const BYTES: usize>(
        &mut self,
        view: &View<'_>,
        how: &Preprocess,
        area: Area,
        elements: &[[[u8; BYTES]; 256]; 3],
        stop_check: Option<&StopCheck<'_>>,
        out: &mut [u8],
    ) -> Result<(), VisionError> {
        let mut resize = self.bilinear.begin(view, (area.width, area.height), how.bgr)?;
        let tensor = TensorRows { how, area, elements };
        // Two rows are read and one is written; without the factor, a row of one pixel is free.
        let work = 2 * view.row(0).len() + 3 * BYTES * how.width as usize;
        for y in 0..how.height {
            if let Some(stop_check) = stop_check {
                stop_check.check(work)?;
            }
            let inside = y.checked_sub(area.top).filter(|y| *y < area.height);
            tensor.write(y, inside.map(|y| resize.row(y)), out);
        }
        Ok(())
    }
}

/// Rows of a tensor whose elements have `BYTES` bytes.
struct TensorRows<'a, const BYTES: usize> {
    how: &'a Preprocess,
    area: Area,
    elements: &'a [[[u8; BYTES]; 256]; 3],
}

impl<const BYTES: usize> TensorRows<'_, BYTES> {
    /// Writes row `y`: pixels of the frame with a border, or only border.
    fn write(&self, y: u32, pixels: Option<&[[u8; 3]]>, out: &mut [u8]) {
        let (out, _) = out.as_chunks_mut::<BYTES>();
        let width = self.how.width as usize;
        let row = y as usize * width;
        let border = self.elements.each_ref().map(|of| of[usize::from(self.how.fill)]);
        if self.how.channels_last {
            let (line, _) = out[3 * row..3 * (row + width)].as_chunks_mut::<3>();
            let [first, second, third] = self.elements;
            self.fill(line, border, pixels, |[a, b, c]| {
                [first[usize::from(a)], second[usize::from(b)], third[usize::from(c)]]
            });
            return;
        }
        let plane = self.how.height as usize * width;
        for (channel, elements) in self.elements.iter().enumerate() {
            let start = channel * plane + row;
            let line = &mut out[start..start + width];
            self.fill(line, border[channel], pixels, |pixel| elements[usize::from(pixel[channel])]);
        }
    }

    /// Fills a line with the converted pixels of the frame, if it has any, and with border.
    fn fill<T: Copy>(
        &self,
        line: &mut [T],
        border: T,
        pixels: Option<&[[u8; 3]]>,
        convert: impl Fn([u8; 3]) -> T,
    ) {
        let Some(pixels) = pixels else {
            line.fill(border);
            return;
        };
        let (left, rest) = line.split_at_mut(self.area.left as usize);
        let (inside, right) = rest.split_at_mut(self.area.width as usize);
        left.fill(border);
        right.fill(border);
        for (element, pixel) in inside.iter_mut().zip(pixels) {
            *element = convert(*pixel);
        }
    }
}

/// Writes the tensor of `view` to `out`, as [`Preparer::prepare`] does, with buffers of its own.
///
/// # Errors
///
/// As for [`Preparer::prepare`].
pub fn prepare(
    view: &View<'_>,
    how: &Preprocess,
    out: &mut Vec<u8>,
) -> Result<Placed, VisionError> {
    Preparer::new().prepare(view, how, out)
}
