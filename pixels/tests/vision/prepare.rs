//! Tensors of small pictures, against a slow reference in `f64`.

use std::cell::Cell;

use gleaner_pixels::vision::{Placement, Preparer, Preprocess, VisionError};
use gleaner_rules::pixels::{Bayer, Encoding, StopCheck, View};

const ENCODINGS: [Encoding; 7] = [
    Encoding::Rgb8,
    Encoding::Bgr8,
    Encoding::Rgba8,
    Encoding::Bgra8,
    Encoding::Mono8,
    Encoding::Yuv422Uyvy,
    Encoding::Yuv422Yuyv,
];

fn how(width: u32, height: u32, placement: Placement) -> Preprocess {
    Preprocess {
        width,
        height,
        placement,
        fill: 114,
        bgr: false,
        channels_last: false,
        bytes: false,
        scale: 1.0,
        mean: [0.0; 3],
        deviation: [1.0; 3],
    }
}

/// Bytes that look random, and are the same in each run.
fn noise(count: usize) -> Vec<u8> {
    let mut state = 0x2545_f491_u32;
    let next = |_| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 11) as u8
    };
    (0..count).map(next).collect()
}

/// Red, green and blue of a pixel.
fn colour(view: &View<'_>, x: u32, y: u32) -> [f64; 3] {
    let row = view.row(y);
    let at = x as usize * view.encoding().bytes_per_pixel();
    let byte = |index: usize| f64::from(row[index]);
    let yuv = |u: usize, luma: usize, v: usize| {
        let (y, u, v) = (byte(luma), byte(u) - 128.0, byte(v) - 128.0);
        [y + 1.402 * v, y - 0.344_136 * u - 0.714_136 * v, y + 1.772 * u]
            .map(|value| value.clamp(0.0, 255.0).round())
    };
    let pair = x as usize / 2 * 4;
    match view.encoding() {
        Encoding::Mono8 => [byte(at); 3],
        Encoding::Rgb8 | Encoding::Rgba8 => [byte(at), byte(at + 1), byte(at + 2)],
        Encoding::Bgr8 | Encoding::Bgra8 => [byte(at + 2), byte(at + 1), byte(at)],
        Encoding::Yuv422Uyvy => yuv(pair, at + 1, pair + 2),
        Encoding::Yuv422Yuyv => yuv(pair + 1, at, pair + 3),
        encoding => panic!("{encoding:?}"),
    }
}

/// Colour of the picture in `width` x `height` pixels, interpolated at the centre of one of them.
fn blended(view: &View<'_>, x: u32, y: u32, width: u32, height: u32) -> [f64; 3] {
    let axis = |at: u32, from: u32, to: u32| {
        let centre = (f64::from(at) + 0.5) * f64::from(from) / f64::from(to) - 0.5;
        let centre = centre.clamp(0.0, f64::from(from - 1));
        let first = centre.floor();
        (first as u32, (first as u32 + 1).min(from - 1), centre - first)
    };
    let (left, right, across) = axis(x, view.width(), width);
    let (top, bottom, down) = axis(y, view.height(), height);
    let mix = |a: [f64; 3], b: [f64; 3], part: f64| {
        [0, 1, 2].map(|channel| a[channel] * (1.0 - part) + b[channel] * part)
    };
    let upper = mix(colour(view, left, top), colour(view, right, top), across);
    let lower = mix(colour(view, left, bottom), colour(view, right, bottom), across);
    mix(upper, lower, down)
}

/// Compares the tensor of `view` with the reference: all elements, within `tolerance` levels.
#[track_caller]
fn compare(view: &View<'_>, how: &Preprocess, [left, top, width, height]: [u32; 4]) {
    let mut out = Vec::new();
    Preparer::new().prepare(view, how, &mut out).unwrap();
    assert_eq!(out.len(), how.size().unwrap());
    let values: Vec<f64> = if how.bytes {
        out.iter().map(|byte| f64::from(*byte)).collect()
    } else {
        let (floats, _) = out.as_chunks::<4>();
        floats.iter().map(|float| f64::from(f32::from_le_bytes(*float))).collect()
    };
    for y in 0..how.height {
        for x in 0..how.width {
            let inside = (left..left + width).contains(&x) && (top..top + height).contains(&y);
            let mut expected = match inside {
                true => blended(view, x - left, y - top, width, height),
                false => [f64::from(how.fill); 3],
            };
            if how.bgr {
                expected.reverse();
            }
            for (channel, level) in expected.into_iter().enumerate() {
                let pixel = (y * how.width + x) as usize;
                let found = values[match how.channels_last {
                    true => 3 * pixel + channel,
                    false => channel * (how.width * how.height) as usize + pixel,
                }];
                let (mean, deviation) = (how.mean[channel], how.deviation[channel]);
                let (expected, unit) = if how.bytes {
                    (level, 1.0)
                } else {
                    let (mean, deviation) = (f64::from(mean), f64::from(deviation));
                    let scale = f64::from(how.scale);
                    ((level * scale - mean) / deviation, (scale / deviation).abs())
                };
                // Weights are in 1/2048, and a yuv colour may be rounded to the other side.
                assert!(
                    (found - expected).abs() <= 1.3 * unit,
                    "{:?} {}x{} {how:?} at {x}, {y}, {channel}: {found}, not {expected}",
                    view.encoding(),
                    view.width(),
                    view.height(),
                );
            }
        }
    }
}

#[test]
fn every_encoding_becomes_every_kind_of_tensor() {
    for encoding in ENCODINGS {
        for (width, height) in [(8, 6), (2, 1), (14, 3), (4, 13)] {
            // With padding after each row.
            let step = width * encoding.bytes_per_pixel() as u32 + 5;
            let data = noise((step * height) as usize);
            let view = View::new(width, height, step, encoding, false, &data).unwrap();
            for choice in 0..8 {
                let how = Preprocess {
                    bgr: choice & 1 > 0,
                    channels_last: choice & 2 > 0,
                    bytes: choice & 4 > 0,
                    scale: 1.0 / 255.0,
                    mean: [0.485, 0.456, 0.406],
                    deviation: [0.229, 0.224, -0.225],
                    ..how(11, 7, Placement::Stretch)
                };
                compare(&view, &how, [0, 0, 11, 7]);
            }
        }
    }
}

#[test]
fn the_border_is_where_the_frame_is_not() {
    let data = noise(3 * 20 * 10);
    let view = View::new(20, 10, 60, Encoding::Rgb8, false, &data).unwrap();
    for channels_last in [false, true] {
        let how = |width, height, placement| Preprocess {
            channels_last,
            ..how(width, height, placement)
        };
        compare(&view, &how(10, 10, Placement::Corner), [0, 0, 10, 5]);
        compare(&view, &how(10, 10, Placement::Centre), [0, 2, 10, 5]);
        compare(&view, &how(13, 5, Placement::Centre), [1, 0, 10, 5]);
        compare(&view, &how(40, 40, Placement::Corner), [0, 0, 40, 20]);
    }
}

#[test]
fn frames_of_one_row_or_column_are_blended() {
    for encoding in [Encoding::Rgb8, Encoding::Bgra8, Encoding::Mono8] {
        for (width, height) in [(1, 1), (1, 9), (9, 1), (2, 2), (1, 2)] {
            let step = width * encoding.bytes_per_pixel() as u32;
            let data = noise((step * height) as usize);
            let view = View::new(width, height, step, encoding, false, &data).unwrap();
            for (across, down) in [(1, 1), (1, 5), (6, 1), (5, 4), (9, 9)] {
                let how = how(across, down, Placement::Stretch);
                compare(&view, &how, [0, 0, across, down]);
            }
        }
    }
    let long = noise(65_535);
    let row = View::new(65_535, 1, 65_535, Encoding::Mono8, false, &long).unwrap();
    compare(&row, &how(8192, 3, Placement::Corner), [0, 0, 8192, 1]);
    let column = View::new(1, 65_535, 1, Encoding::Mono8, false, &long).unwrap();
    compare(&column, &how(3, 64, Placement::Centre), [1, 0, 1, 64]);
}

#[test]
fn a_frame_of_the_size_of_the_tensor_is_copied() {
    let data = noise(3 * 16 * 12);
    let view = View::new(16, 12, 48, Encoding::Bgr8, false, &data).unwrap();
    let how = Preprocess {
        bgr: true,
        channels_last: true,
        bytes: true,
        ..how(16, 12, Placement::Centre)
    };
    let mut out = Vec::new();
    Preparer::new().prepare(&view, &how, &mut out).unwrap();
    assert_eq!(out, data);
}

#[test]
fn a_preparer_gives_the_same_result_for_frames_in_any_order() {
    let data = noise(4 * 30 * 20);
    let mut preparer = Preparer::new();
    let (mut used, mut fresh) = (Vec::new(), Vec::new());
    for (encoding, width, height) in [
        (Encoding::Rgb8, 30, 20),
        (Encoding::Yuv422Uyvy, 4, 20),
        (Encoding::Mono8, 1, 1),
        (Encoding::Bgra8, 29, 2),
        (Encoding::Rgb8, 30, 20),
    ] {
        let step = width * encoding.bytes_per_pixel() as u32;
        let view = View::new(width, height, step, encoding, false, &data).unwrap();
        for size in [7, 33] {
            let how = how(size, size, Placement::Centre);
            let placed = preparer.prepare(&view, &how, &mut used).unwrap();
            assert_eq!(Preparer::new().prepare(&view, &how, &mut fresh).unwrap(), placed);
            assert_eq!(used, fresh);
        }
    }
}

#[test]
fn frames_without_colour_or_with_16_bits_are_refused_with_a_way_out() {
    let data = [0; 64];
    let refusal = |encoding: Encoding| {
        let step = 4 * encoding.bytes_per_pixel() as u32;
        let view = View::new(4, 4, step, encoding, false, &data).unwrap();
        let mut out = Vec::new();
        let error =
            Preparer::new().prepare(&view, &how(4, 4, Placement::Stretch), &mut out).unwrap_err();
        assert!(out.is_empty());
        error.to_string()
    };
    assert_eq!(
        refusal(Encoding::Mono16),
        "frame of mono16: a tensor is made of rgb8, bgr8, rgba8, bgra8, mono8, uyvy or yuyv; \
         publish it with 8 bits, as mono8"
    );
    for bayer in [Encoding::Bayer8(Bayer::Rggb), Encoding::Bayer16(Bayer::Grbg)] {
        let message = refusal(bayer);
        assert!(message.starts_with(&format!("frame of {}", bayer.name())), "{message}");
        assert!(message.ends_with("debayer it first, for example by image_proc"), "{message}");
    }
}

#[test]
fn numbers_that_make_no_tensor_are_refused() {
    let view = View::new(1, 1, 1, Encoding::Mono8, false, &[9]).unwrap();
    let refusal = |how: Preprocess| {
        Preparer::new().prepare(&view, &how, &mut Vec::new()).unwrap_err().to_string()
    };
    let good = how(4, 4, Placement::Stretch);
    for (width, height) in [(0, 4), (4, 0), (8193, 4), (4, u32::MAX)] {
        assert_eq!(
            refusal(Preprocess { width, height, ..good }),
            format!("tensor of {width}x{height} pixels: each side must be 1 to 8192")
        );
    }
    let end = "; it must be finite, and a deviation not 0";
    for (how, start) in [
        (Preprocess { scale: f32::NAN, ..good }, "scale of the tensor is NaN"),
        (Preprocess { mean: [0.0, f32::INFINITY, 0.0], ..good }, "mean of the tensor is inf"),
        (Preprocess { deviation: [1.0, 1.0, 0.0], ..good }, "deviation of the tensor is 0"),
        (Preprocess { deviation: [f32::NAN; 3], ..good }, "deviation of the tensor is NaN"),
    ] {
        assert_eq!(refusal(how), format!("{start}{end}"));
        // Bytes do not use the numbers.
        assert!(
            Preparer::new()
                .prepare(&view, &Preprocess { bytes: true, ..how }, &mut Vec::new())
                .is_ok()
        );
    }
    let mut out = [0; 191];
    let error = Preparer::new().prepare_into(&view, &good, None, &mut out).unwrap_err();
    assert_eq!(error.to_string(), "tensor needs 192 bytes; the output has 191");
}

#[test]
fn the_caller_can_stop_between_rows() {
    let data = noise(3 * 1920 * 1080);
    let view = View::new(1920, 1080, 3 * 1920, Encoding::Bgr8, false, &data).unwrap();
    let how = how(640, 640, Placement::Corner);
    let mut out = vec![1; how.size().unwrap()];
    for at in [1, 2, 20] {
        let checks = Cell::new(0);
        let may_continue = || {
            checks.set(checks.get() + 1);
            checks.get() < at
        };
        let stop_check = StopCheck::new(&may_continue);
        out.fill(1);
        let result = Preparer::new().prepare_into(&view, &how, Some(&stop_check), &mut out);
        assert!(matches!(result, Err(VisionError::Pixels(_))), "{result:?}");
        assert_eq!(checks.get(), at, "it continued after it was stopped");
        let written = out.chunks_exact(4).filter(|float| **float != [1; 4]).count();
        assert!(written <= at as usize * 8 * 3 * 640, "{written}");
    }
}
