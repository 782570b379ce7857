//! Decodes JPEG: checks the structure of the file; `zune-jpeg` decodes the pixels.
//!
//! A decoder of photographs is lenient: it returns a picture for half a file. Lambdas that judge
//! frames need errors, so all markers are checked first. That also bounds the time: a sequential
//! image has one scan, a progressive one has at most [`MAX_SCANS`].
//!
//! Compared with libjpeg-turbo on files of every subsampling, `zune-jpeg` 0.5.15 silently decodes
//! two rare kinds wrong: components in scans of their own (sequential), and luma that is coarser
//! than chroma. Both are refused here. On x86-64, its vector and scalar code returned the same
//! bytes for 85 photographs and for 60,000 damaged files, so its vector code stays on. NEON,
//! emulated, returned the bytes of x86-64 and of its own scalar code for 16,000 files, most of them
//! damaged, of every subsampling.

use std::cell::Cell;

use gleaner_rules::pixels::{Encoding, PixelError, StopCheck, check_size};
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::paced::PacedReader;
use super::{Format, ImageError, ImageHeader};

/// Start of image, and the start of the marker that must follow.
pub(super) const MAGIC: [u8; 3] = [0xff, 0xd8, 0xff];

/// A segment of frames in AVI files, for which `zune-jpeg` uses the Huffman tables of ITU-T T.81,
/// annex K.3. Cameras that send MJPEG leave these tables out, with or without this segment.
const STANDARD_TABLES: &[u8] = b"\xff\xe0\0\x07AVI1\0";

/// Maximum number of scans of a progressive image. Encoders write about ten.
const MAX_SCANS: usize = 64;

/// Returns the header of `data`, which starts with [`MAGIC`].
pub(super) fn header(data: &[u8]) -> Result<ImageHeader, ImageError> {
    Ok(frame(data)?.header())
}

/// Decodes `data` into `out`, which is black and has the length that `header` requires, with at
/// most `allowed` bytes of further memory.
pub(super) fn decode(
    data: &[u8],
    header: &ImageHeader,
    allowed: usize,
    out: &mut [u8],
    pace: &StopCheck<'_>,
) -> Result<(), ImageError> {
    let &ImageHeader { format, width, height, .. } = header;
    let frame = frame(data)?;
    let needed = frame.working_memory();
    if needed > allowed as u64 {
        return Err(ImageError::WorkingMemory { format, width, height, needed, allowed });
    }
    let completed;
    let data = if check_structure(data)? || frame.progressive {
        data
    } else {
        completed = [&data[..2], STANDARD_TABLES, &data[2..]].concat();
        &completed
    };
    let stopped = Cell::new(false);
    let refused = |cause| match stopped.get() {
        true => PixelError::Stopped.into(),
        false => ImageError::Jpeg { width, height, cause },
    };
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(width as usize)
        .set_max_height(height as usize)
        .jpeg_set_max_scans(MAX_SCANS)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder =
        JpegDecoder::new_with_options(PacedReader::new(data, pace, &stopped), options);
    decoder.decode_headers().map_err(refused)?;
    // Both parsers must read the same header.
    if decoder.output_buffer_size() != Some(out.len()) {
        return Err(damaged(0, "its header is ambiguous"));
    }
    decoder.decode_into(out).map_err(refused)?;
    // The decoder fills in the end of some truncated files.
    if stopped.get() { Err(PixelError::Stopped.into()) } else { Ok(()) }
}

/// Content of the frame header (SOF).
#[derive(Debug, Clone, Copy)]
struct FrameHeader {
    width: u32,
    height: u32,
    progressive: bool,
    /// 1 or 3.
    components: usize,
    /// Horizontal and vertical sampling factors, 1, 2 or 4: of luma, then of both kinds of chroma,
    /// which must not be larger.
    sampling: [(u8, u8); 3],
}

impl FrameHeader {
    fn header(&self) -> ImageHeader {
        let (width, height) = (self.width, self.height);
        ImageHeader { format: Format::Jpeg, width, height, encoding: Encoding::Rgb8 }
    }

    /// Returns the maximum that `zune-jpeg` 0.5 allocates, in bytes: two for each coefficient of a
    /// progressive image, and rows of blocks in several states of upsampling. According to its
    /// source, these are at most 35 values of two bytes for each sample of a row of luma and
    /// component.
    fn working_memory(&self) -> u64 {
        let sampling = &self.sampling[..self.components];
        let (wide, high) = (u64::from(sampling[0].0), u64::from(sampling[0].1));
        let columns = u64::from(self.width).div_ceil(8 * wide);
        let rows = u64::from(self.height).div_ceil(8 * high);
        let factors = sampling.iter().map(|(h, v)| u64::from(*h * *v));
        let blocks = columns * rows * factors.sum::<u64>();
        let coefficients = if self.progressive { blocks * 64 * 2 } else { 0 };
        coefficients + sampling.len() as u64 * columns * 8 * wide * high * 35 * 2
    }
}

/// Parses `data` up to its frame header.
fn frame(data: &[u8]) -> Result<FrameHeader, ImageError> {
    let mut segments = JpegSegments::of(data);
    loop {
        let segment = segments.next()?;
        match segment.marker {
            0xc0..=0xc2 => return frame_of(&segment),
            marker => supported(marker)?,
        }
        if matches!(segment.marker, SCAN | END) {
            return Err(damaged(segment.at, "pixels before the frame header"));
        }
    }
}

/// Refuses the kinds of JPEG that cameras do not send, by their markers.
fn supported(marker: u8) -> Result<(), ImageError> {
    let what = match marker {
        0xc3 | 0xc7 | 0xcb | 0xcf => "lossless",
        0xc5 | 0xc6 | 0xde => "hierarchical",
        0xc9 | 0xca | 0xcc | 0xcd | 0xce => "arithmetic-coded",
        0xdc => "of a height that follows its pixels",
        _ => return Ok(()),
    };
    Err(unsupported(what))
}

fn frame_of(segment: &JpegSegment<'_>) -> Result<FrameHeader, ImageError> {
    let &[precision, h1, h0, w1, w0, components, ref parts @ ..] = segment.body else {
        return Err(damaged(segment.at, "a frame header that is too short"));
    };
    let width = u32::from(u16::from_be_bytes([w1, w0]));
    let height = u32::from(u16::from_be_bytes([h1, h0]));
    check_size(width, height)?;
    if precision != 8 {
        return Err(unsupported("not of 8 bits per value"));
    }
    let components = usize::from(components);
    if components != 1 && components != 3 {
        return Err(unsupported("neither grey nor of three components (CMYK?)"));
    }
    if parts.len() != 3 * components {
        return Err(damaged(segment.at, "a frame header of the wrong length"));
    }
    let mut sampling = [(1, 1); 3];
    for (factors, part) in sampling.iter_mut().zip(parts.as_chunks::<3>().0) {
        *factors = (part[1] >> 4, part[1] & 15);
    }
    let known = |(h, v)| matches!(h, 1 | 2 | 4) && matches!(v, 1 | 2 | 4);
    let [luma, chroma, other] = sampling;
    let finer = components == 3 && (chroma.0 > luma.0 || chroma.1 > luma.1);
    if !known(luma) || !known(chroma) || other != chroma || finer {
        return Err(unsupported("subsampled in a way that cameras do not use"));
    }
    Ok(FrameHeader { width, height, progressive: segment.marker == 0xc2, components, sampling })
}

/// Checks all of `data`: one frame header, then its scans, then the end. Returns whether it has
/// Huffman tables.
fn check_structure(data: &[u8]) -> Result<bool, ImageError> {
    let mut segments = JpegSegments::of(data);
    let mut frame: Option<FrameHeader> = None;
    let mut scans = 0;
    let mut has_tables = false;
    loop {
        let segment = segments.next()?;
        let at = segment.at;
        match (segment.marker, &frame) {
            (0xc0..=0xc2, None) => frame = Some(frame_of(&segment)?),
            (0xc0..=0xc2, Some(_)) => return Err(damaged(at, "a second frame header")),
            (SCAN, None) => return Err(damaged(at, "pixels before the frame header")),
            (SCAN, Some(frame)) => {
                scans += 1;
                let in_scan = segment.body.first().map(|count| usize::from(*count));
                if !frame.progressive && in_scan != Some(frame.components) {
                    let what = "sequential with components in scans of their own";
                    return Err(unsupported(what));
                }
                if scans > if frame.progressive { MAX_SCANS } else { 1 } {
                    return Err(damaged(at, "more scans than such an image can need"));
                }
            }
            (END, _) if scans == 0 => return Err(damaged(at, "an end before any pixels")),
            (END, _) => return Ok(has_tables),
            (TABLES, _) => has_tables = true,
            (marker, _) => supported(marker)?,
        }
    }
}

const TABLES: u8 = 0xc4;
const SCAN: u8 = 0xda;
const END: u8 = 0xd9;

/// A marker with its content; for [`SCAN`], the content of its header.
struct JpegSegment<'a> {
    marker: u8,
    at: usize,
    body: &'a [u8],
}

/// Iterates over the markers, also across entropy-coded data.
struct JpegSegments<'a> {
    data: &'a [u8],
    at: usize,
}

impl<'a> JpegSegments<'a> {
    /// Starts at the first marker of `data`, which starts with [`MAGIC`].
    fn of(data: &'a [u8]) -> Self {
        Self { data, at: 2 }
    }

    fn next(&mut self) -> Result<JpegSegment<'a>, ImageError> {
        if self.byte(self.at)? != 0xff {
            return Err(damaged(self.at, "no marker where one is required"));
        }
        // Any number of fill bytes may precede a marker.
        let mut at = self.at + 1;
        while self.byte(at)? == 0xff {
            at += 1;
        }
        let marker = self.byte(at)?;
        if marker == END {
            return Ok(JpegSegment { marker, at, body: &[] });
        }
        if matches!(marker, 0x00 | 0x01 | 0xd0..=0xd8) {
            return Err(damaged(at, "a marker without content between segments"));
        }
        let len = usize::from(u16::from_be_bytes([self.byte(at + 1)?, self.byte(at + 2)?]));
        if len < 2 {
            return Err(damaged(at, "a segment that is shorter than its own length"));
        }
        self.at = at + 1 + len;
        let body = self.data.get(at + 3..self.at).ok_or_else(|| truncated(self.data))?;
        if marker == SCAN {
            self.skip_pixels();
        }
        Ok(JpegSegment { marker, at, body })
    }

    fn byte(&self, at: usize) -> Result<u8, ImageError> {
        self.data.get(at).copied().ok_or_else(|| truncated(self.data))
    }

    /// Moves to the next marker, or the end of the data. In entropy-coded data, 0xff is followed by
    /// 0 if it is data, and by 0xd0 to 0xd7 if it is a restart.
    fn skip_pixels(&mut self) {
        while let Some(rest) = self.data.get(self.at..) {
            let Some(marker) = rest.iter().position(|byte| *byte == 0xff) else {
                break;
            };
            self.at += marker;
            match self.data.get(self.at + 1) {
                Some(0x00 | 0xd0..=0xd7) => self.at += 2,
                Some(_) => return,
                None => break,
            }
        }
        self.at = self.data.len();
    }
}

fn truncated(data: &[u8]) -> ImageError {
    ImageError::Truncated { format: Format::Jpeg, len: data.len() }
}

fn damaged(at: usize, what: &'static str) -> ImageError {
    ImageError::Damaged { format: Format::Jpeg, at, what }
}

fn unsupported(what: &'static str) -> ImageError {
    ImageError::Unsupported { format: Format::Jpeg, what }
}
