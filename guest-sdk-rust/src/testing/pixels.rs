//! What the host computes on frames, written plainly: in integers only, so that results are those of the host, bit for bit.
//!
//! Sources: ITU-R BT.601 for luma; JFIF 1.02 for colours of yuv422.

use super::types::{Encoding, Roi};
use crate::data::{bytes_per_pixel, encoding_name};
use crate::kernels::MAX_SIDE;

const MAX_RESIZED_SIDE: u32 = 16_384;

/// Pixels of a checked size.
pub(super) struct View<'a> {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) encoding: Encoding,
    pub(super) step: u32,
    pub(super) big_endian: bool,
    /// All rows; the last one without padding.
    pub(super) data: &'a [u8],
}

/// Why pixels are no image, or an operation on them has no result.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum PixelError {
    /// The image contradicts itself, or has no colours.
    NotAFrame(String),
    /// A region or a size that does not fit.
    OutOfRange(String),
}

type Answer<T> = Result<T, PixelError>;

/// Every name that is understood in a message. Where an encoding has several names, the first is said in messages.
const NAMES: [(&str, Encoding); 21] = [
    ("rgb8", Encoding::Rgb8),
    ("bgr8", Encoding::Bgr8),
    ("8UC3", Encoding::Bgr8),
    ("rgba8", Encoding::Rgba8),
    ("bgra8", Encoding::Bgra8),
    ("mono8", Encoding::Mono8),
    ("8UC1", Encoding::Mono8),
    ("mono16", Encoding::Mono16),
    ("16UC1", Encoding::Mono16),
    ("uyvy", Encoding::Yuv422),
    ("yuv422", Encoding::Yuv422),
    ("yuyv", Encoding::Yuv422Yuy2),
    ("yuv422_yuy2", Encoding::Yuv422Yuy2),
    ("bayer_rggb8", Encoding::BayerRggb8),
    ("bayer_bggr8", Encoding::BayerBggr8),
    ("bayer_gbrg8", Encoding::BayerGbrg8),
    ("bayer_grbg8", Encoding::BayerGrbg8),
    ("bayer_rggb16", Encoding::BayerRggb16),
    ("bayer_bggr16", Encoding::BayerBggr16),
    ("bayer_gbrg16", Encoding::BayerGbrg16),
    ("bayer_grbg16", Encoding::BayerGrbg16),
];

/// The encoding that ROS calls `name`.
pub(super) fn encoding_of(name: &str) -> Answer<Encoding> {
    NAMES.iter().find(|(known, _)| *known == name).map(|(_, encoding)| *encoding).ok_or_else(|| {
        let shown = match name.char_indices().nth(40) {
            None => name.to_owned(),
            Some((end, _)) => format!("{}…", &name[..end]),
        };
        let supported = NAMES.map(|(known, _)| known).join(", ");
        PixelError::NotAFrame(format!("encoding `{shown}` is not supported; supported are {supported}"))
    })
}

fn name_of(encoding: Encoding) -> &'static str {
    NAMES.iter().find(|(_, known)| *known == encoding).map_or(encoding_name(encoding), |(name, _)| name)
}

/// How a pixel is read.
#[derive(Clone, Copy)]
enum Layout {
    Grey,
    /// The byte of the higher eight bits.
    Grey16(usize),
    /// Where red, green and blue are.
    Colours([usize; 3]),
    /// Where U, the left Y, V and the right Y are in a pair of pixels.
    Pairs([usize; 4]),
}

impl<'a> View<'a> {
    /// As the fields of a `sensor_msgs/msg/Image` say.
    pub(super) fn new(
        (width, height): (u32, u32),
        encoding: Encoding,
        step: u32,
        big_endian: bool,
        data: &'a [u8],
    ) -> Answer<Self> {
        let refuse = |why: String| Err(PixelError::NotAFrame(why));
        let said = name_of(encoding);
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return refuse(format!("image says it is {width}x{height}; each side must be 1 to {MAX_SIDE}"));
        }
        if matches!(encoding, Encoding::Yuv422 | Encoding::Yuv422Yuy2) && width % 2 == 1 {
            let why = "two pixels share a colour, so the width must be even";
            return refuse(format!("image of {said} is {width} pixels wide; {why}"));
        }
        let row = width * bytes_per_pixel(encoding);
        if step < row {
            return refuse(format!("image of {width}x{height} {said} says a row has {step} bytes; it needs {row}"));
        }
        let needed = u64::from(step) * u64::from(height - 1) + u64::from(row);
        let Some(data) = usize::try_from(needed).ok().and_then(|needed| data.get(..needed)) else {
            let found = data.len();
            return refuse(format!(
                "image of {width}x{height} {said} with {step} bytes per row needs {needed} bytes; it has {found}"
            ));
        };
        Ok(Self { width, height, encoding, step, big_endian, data })
    }

    fn layout(&self, operation: &str) -> Answer<Layout> {
        Ok(match self.encoding {
            Encoding::Mono8 => Layout::Grey,
            Encoding::Mono16 => Layout::Grey16(usize::from(!self.big_endian)),
            Encoding::Rgb8 | Encoding::Rgba8 => Layout::Colours([0, 1, 2]),
            Encoding::Bgr8 | Encoding::Bgra8 => Layout::Colours([2, 1, 0]),
            Encoding::Yuv422 => Layout::Pairs([0, 1, 2, 3]),
            Encoding::Yuv422Yuy2 => Layout::Pairs([1, 0, 3, 2]),
            raw => {
                let why = "its pixels have no colour until it is debayered";
                return Err(PixelError::NotAFrame(format!("{operation} of a raw image ({}): {why}", name_of(raw))));
            }
        })
    }

    fn pixel(&self, x: u32, y: u32) -> &[u8] {
        let bytes = bytes_per_pixel(self.encoding) as usize;
        let at = y as usize * self.step as usize + x as usize * bytes;
        &self.data[at..at + bytes]
    }

    /// Columns and rows of a region, clipped to the image; of all, if there is none.
    fn clip(&self, roi: Option<Roi>) -> Answer<(std::ops::Range<u32>, std::ops::Range<u32>)> {
        let (width, height) = (self.width, self.height);
        let Some(Roi { x, y, width: across, height: down }) = roi else { return Ok((0..width, 0..height)) };
        if x >= width || y >= height || across == 0 || down == 0 {
            return Err(PixelError::OutOfRange(format!(
                "region {across}x{down} at ({x}, {y}) has no pixel in the image of {width}x{height}"
            )));
        }
        Ok((x..x.saturating_add(across).min(width), y..y.saturating_add(down).min(height)))
    }

    pub(super) fn mean_luma(&self, roi: Option<Roi>) -> Answer<f64> {
        let layout = self.layout("mean luma")?;
        let (columns, rows) = self.clip(roi)?;
        let count = u64::from(columns.end - columns.start) * u64::from(rows.end - rows.start);
        let mut sum = 0_u64;
        for y in rows {
            for x in columns.clone() {
                let pixel = self.pixel(x, y);
                sum += match layout {
                    Layout::Grey => u64::from(pixel[0]),
                    Layout::Grey16(high) => 256 * u64::from(pixel[high]) + u64::from(pixel[1 - high]),
                    Layout::Colours(at) => thousandths(at.map(|at| pixel[at])).into(),
                    Layout::Pairs(at) => u64::from(pixel[at[1]]),
                };
            }
        }
        let scale = match layout {
            Layout::Grey | Layout::Pairs(_) => 1,
            Layout::Grey16(_) => 257,
            Layout::Colours(_) => 1000,
        };
        Ok(sum as f64 / (scale * count) as f64)
    }

    pub(super) fn histogram(&self, roi: Option<Roi>) -> Answer<Vec<u32>> {
        let layout = self.layout("histogram")?;
        let (columns, rows) = self.clip(roi)?;
        let mut counts = vec![0; 256];
        for y in rows {
            for x in columns.clone() {
                counts[usize::from(self.grey(layout, x, y))] += 1;
            }
        }
        Ok(counts)
    }

    pub(super) fn to_gray(&self) -> Answer<Vec<u8>> {
        let layout = self.layout("grey image")?;
        let places = (0..self.height).flat_map(|y| (0..self.width).map(move |x| (x, y)));
        Ok(places.map(|(x, y)| self.grey(layout, x, y)).collect())
    }

    fn grey(&self, layout: Layout, x: u32, y: u32) -> u8 {
        let pixel = self.pixel(x, y);
        match layout {
            Layout::Grey => pixel[0],
            Layout::Grey16(high) => pixel[high],
            Layout::Colours(at) => (thousandths(at.map(|at| pixel[at])) / 1000) as u8,
            Layout::Pairs(at) => pixel[at[1]],
        }
    }

    fn rgb(&self, layout: Layout, x: u32, y: u32) -> [u8; 3] {
        match layout {
            Layout::Colours(at) => at.map(|at| self.pixel(x, y)[at]),
            Layout::Pairs([u, left, v, right]) => {
                let byte = |at: usize| i32::from(self.pixel(x - x % 2 + at as u32 / 2, y)[at % 2]);
                let luma = (byte(if x.is_multiple_of(2) { left } else { right }) << 16) + (1 << 15);
                let (u, v) = (byte(u) - 128, byte(v) - 128);
                // Factors in 1/65536, rounded to nearest.
                let channels = [luma + 91_881 * v, luma - 22_554 * u - 46_802 * v, luma + 116_130 * u];
                channels.map(|channel| (channel >> 16).clamp(0, 255) as u8)
            }
            Layout::Grey | Layout::Grey16(_) => [self.grey(layout, x, y); 3],
        }
    }

    /// What [`resize`](Self::resize) makes.
    pub(super) fn resized(&self, width: u32, height: u32) -> Answer<Encoding> {
        let layout = self.layout("resize")?;
        let fits = |side| (1..=MAX_RESIZED_SIDE).contains(&side);
        if !fits(width) || !fits(height) {
            let why = format!("each side must be 1 to {MAX_RESIZED_SIDE}");
            return Err(PixelError::OutOfRange(format!("resize to {width}x{height}: {why}")));
        }
        Ok(if matches!(layout, Layout::Grey | Layout::Grey16(_)) { Encoding::Mono8 } else { Encoding::Rgb8 })
    }

    /// Each axis by itself: the mean of the covered area where the image shrinks, linear where it grows; both exact, and rounded
    /// once, to nearest.
    pub(super) fn resize(&self, width: u32, height: u32) -> Answer<Vec<u8>> {
        let layout = self.layout("resize")?;
        let channels = bytes_per_pixel(self.resized(width, height)?) as usize;
        let (down, down_total) = weights(self.height, height);
        let (across, across_total) = weights(self.width, width);
        let total = down_total * across_total;
        let mut made = Vec::with_capacity(width as usize * height as usize * channels);
        for rows in &down {
            let mut columns = vec![[0_u64; 3]; self.width as usize];
            for (y, weight) in rows {
                for (x, sums) in (0..).zip(&mut columns) {
                    let rgb = self.rgb(layout, x, *y);
                    (0..channels).for_each(|channel| sums[channel] += weight * u64::from(rgb[channel]));
                }
            }
            for taps in &across {
                let sum =
                    |channel: usize| taps.iter().map(|(x, weight)| weight * columns[*x as usize][channel]).sum::<u64>();
                made.extend((0..channels).map(|channel| ((sum(channel) + total / 2) / total) as u8));
            }
        }
        Ok(made)
    }
}

fn thousandths([red, green, blue]: [u8; 3]) -> u32 {
    299 * u32::from(red) + 587 * u32::from(green) + 114 * u32::from(blue)
}

/// Of each new pixel on an axis, the old ones that it is made of with their weights, whose sum is the number beside.
fn weights(old: u32, new: u32) -> (Vec<Vec<(u32, u64)>>, u64) {
    let (from, to) = (u64::from(old), u64::from(new));
    let shrunk = |at: u64| {
        // The axis is cut into `from * to` pieces; a weight is how many pieces both have.
        let (start, end) = (at * from, (at + 1) * from);
        let shared = |source: u64| end.min((source + 1) * to) - start.max(source * to);
        (start / to..=(end - 1) / to).map(|source| (source as u32, shared(source))).collect()
    };
    let grown = |at: u64| {
        // The middle of the new pixel, in 1 / (2 `to`) of an old one.
        let middle = ((2 * at + 1) * from).saturating_sub(to);
        let (first, past) = (middle / (2 * to), middle % (2 * to));
        match first + 1 < from {
            true => vec![(first as u32, 2 * to - past), (first as u32 + 1, past)],
            false => vec![(first as u32, 2 * to)],
        }
    };
    match to <= from {
        true => ((0..to).map(shrunk).collect(), from),
        false => ((0..to).map(grown).collect(), 2 * to),
    }
}
