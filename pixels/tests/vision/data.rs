//! Tensors of a photo, against those that others made of it with OpenCV.
//!
//! The pictures are not part of the repository. Without them the tests print so and pass.

use std::fs;

use gleaner_pixels::vision::{DetectorLayout, Placement, Preparer, Preprocess};
use gleaner_pixels::{decode_rgb8, probe};
use gleaner_rules::pixels::{Encoding, View};

use gleaner_test_support::shared_file;

struct Picture {
    width: u32,
    height: u32,
    rgb: Vec<u8>,
}

/// Reads a picture of the shared data, if it is there.
fn picture(name: &str) -> Option<Picture> {
    let path = shared_file(name).inspect_err(|why| println!("skipped: {why}")).ok()?;
    let bytes = fs::read(&path).unwrap();
    let header = probe(&bytes).unwrap();
    let mut rgb = vec![0; header.rgb8_len().unwrap()];
    decode_rgb8(&bytes, &header, rgb.len(), &mut rgb).unwrap();
    Some(Picture { width: header.width, height: header.height, rgb })
}

/// Returns the mean of the absolute differences of the tensor of the photo from `expected`, in
/// levels.
fn difference(how: Preprocess, photo: &Picture, expected: &[u8]) -> f64 {
    let Picture { width, height, rgb } = photo;
    let view = View::new(*width, *height, 3 * width, Encoding::Rgb8, false, rgb).unwrap();
    let how = Preprocess { bytes: true, bgr: false, channels_last: true, ..how };
    let mut out = Vec::new();
    Preparer::new().prepare(&view, &how, &mut out).unwrap();
    assert_eq!(out.len(), expected.len());
    let differences = out.iter().zip(expected).map(|(a, b)| u64::from(a.abs_diff(*b)));
    let mean = differences.sum::<u64>() as f64 / out.len() as f64;
    eprintln!("{}x{}: mean difference of {mean:.4} levels", how.width, how.height);
    mean
}

fn input(layout: DetectorLayout, width: u32, height: u32) -> Preprocess {
    layout.preprocess(&[Some(1), Some(3), Some(height), Some(width)]).unwrap()
}

#[test]
fn a_centred_photo_is_that_of_opencv() {
    let Some(photo) = picture("images/coco/000000000074.jpg") else {
        return;
    };
    for (name, side) in
        [("models/input_yolo11n_int8_320.png", 320), ("models/input_yolov8n_int8_640.png", 640)]
    {
        let Some(expected) = picture(name) else {
            return;
        };
        let how = input(DetectorLayout::Ultralytics, side, side);
        // The rest is the difference of two JPEG decoders.
        assert!(difference(how, &photo, &expected.rgb) < 0.05);
    }
}

#[test]
fn a_photo_in_the_corner_is_that_of_opencv() {
    let (Some(photo), Some(expected)) =
        (picture("images/coco/000000000074.jpg"), picture("models/input_yolox_nano.png"))
    else {
        return;
    };
    // YOLOX rounds the 276.9 rows of this photo down; the tool that made the picture, to nearest.
    let rows = 277;
    let (inside, border) = expected.rgb.split_at(3 * 416 * rows);
    let how = Preprocess {
        placement: Placement::Stretch,
        ..input(DetectorLayout::Yolox, 416, rows as u32)
    };
    assert!(difference(how, &photo, inside) < 0.05);
    assert!(border.iter().all(|level| *level == how.fill));
    // The row that is missing moves the edges of the picture by up to one pixel.
    assert!(difference(input(DetectorLayout::Yolox, 416, 416), &photo, &expected.rgb) < 5.0);
}
