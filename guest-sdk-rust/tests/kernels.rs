//! Compares kernels with the host's operations on frames: results are equal, bit for bit, for every
//! pixel layout.

use gleaner_rules::pixels::{self, Encoding as HostEncoding, Roi as HostRoi, View, ops};
use gleaner_sdk::data::{Encoding, Roi};
use gleaner_sdk::kernels::{self, Image, downscale, histogram, luma, mean};

const ENCODINGS: [(Encoding, &str); 3] =
    [(Encoding::Rgb8, "rgb8"), (Encoding::Bgr8, "bgr8"), (Encoding::Mono8, "mono8")];

/// Pseudo-random numbers, the same in every run.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as u32
    }

    /// Returns a number from 1 to `most`.
    fn up_to(&mut self, most: u32) -> u32 {
        1 + self.next() % most
    }
}

/// The same pixels for kernels and for the host.
struct TestPixels {
    width: u32,
    height: u32,
    step: u32,
    data: Vec<u8>,
}

impl TestPixels {
    fn new(noise: &mut Noise, width: u32, height: u32) -> Self {
        let step = 3 * width + [0, noise.next() % 9][noise.next() as usize % 2];
        // Sometimes few levels, sometimes only high ones, for large counts and large sums.
        let (mask, floor) = (
            [0xff, 0xff, 0x81, 0x00][noise.next() as usize % 4],
            [0, 0xfe][noise.next() as usize % 2],
        );
        let data = (0..step * height).map(|_| noise.next() as u8 & mask | floor).collect();
        Self { width, height, step, data }
    }

    fn each(&self, mut check: impl FnMut(Image<'_>, View<'_>, &str)) {
        let Self { width, height, step, data } = self;
        for (encoding, name) in ENCODINGS {
            let image = Image::new(*width, *height, *step, encoding, data).unwrap();
            let view = View::new(
                *width,
                *height,
                *step,
                HostEncoding::from_ros(name).unwrap(),
                false,
                data,
            )
            .unwrap();
            check(image, view, &format!("{width}x{height}, step {step}, {name}"));
        }
    }
}

/// Odd sizes, remainders of every length, and a row longer than the longest block of sums.
fn sizes(noise: &mut Noise) -> Vec<(u32, u32)> {
    let random = (0..150).map(|_| (noise.up_to(140), noise.up_to(20))).collect::<Vec<_>>();
    [random, vec![(1, 1), (32, 1), (33, 2), (512, 2), (513, 1), (9000, 2)]].concat()
}

#[test]
fn means_histograms_and_grey_images_are_those_of_the_host() {
    let mut noise = Noise(1);
    for (width, height) in sizes(&mut noise) {
        let pixels = TestPixels::new(&mut noise, width, height);
        let [x, y] = [width, height].map(|side| noise.next() % side);
        let [across, down] = [width, height].map(|side| noise.up_to(side));
        pixels.each(|image, view, what| {
            assert_eq!(luma::mean_luma(&image), ops::mean_luma(&view, None).unwrap(), "{what}");
            assert_eq!(
                histogram::histogram(&image),
                ops::histogram(&view, None).unwrap(),
                "{what}"
            );
            let mut by_kernel = vec![0; (width * height) as usize];
            let mut by_host = by_kernel.clone();
            luma::to_gray(&image, &mut by_kernel).unwrap();
            ops::to_gray(&view, &mut by_host).unwrap();
            assert_eq!(by_kernel, by_host, "{what}");

            let part = image.part(Roi { x, y, width: across, height: down }).unwrap();
            let roi = Some(HostRoi { x, y, width: across, height: down });
            assert_eq!(
                luma::mean_luma(&part),
                ops::mean_luma(&view, roi).unwrap(),
                "{what}, {roi:?}"
            );
            assert_eq!(
                histogram::histogram(&part),
                ops::histogram(&view, roi).unwrap(),
                "{what}, {roi:?}"
            );
        });
    }
}

#[test]
fn the_mean_of_colours_is_that_of_each_pixel() {
    let mut noise = Noise(2);
    for (width, height) in sizes(&mut noise) {
        let pixels = TestPixels::new(&mut noise, width, height);
        let mut sums = [0_u32; 3];
        for row in pixels.data.chunks(pixels.step as usize) {
            for pixel in row[..3 * width as usize].chunks(3) {
                sums = std::array::from_fn(|at| sums[at] + u32::from(pixel[at]));
            }
        }
        let expected = sums.map(|sum| f64::from(sum) / f64::from(width * height));
        let image = Image::new(width, height, pixels.step, Encoding::Rgb8, &pixels.data).unwrap();
        assert_eq!(mean::mean_rgb(&image), expected, "{width}x{height}");
    }
}

#[test]
fn downscaled_images_are_those_of_the_host() {
    let mut noise = Noise(3);
    for (width, height) in sizes(&mut noise) {
        let pixels = TestPixels::new(&mut noise, width, height);
        let (to_width, to_height) = match noise.next() % 3 {
            0 => (width, noise.up_to(height)),
            1 => (width.div_ceil(2), height.div_ceil(3)),
            _ => (noise.up_to(width), noise.up_to(height)),
        };
        pixels.each(|image, view, what| {
            let mut by_kernel =
                vec![0; downscale::downscaled(&image, to_width, to_height).unwrap()];
            let mut by_host = vec![0; ops::resized(&view, to_width, to_height).unwrap().1];
            downscale::downscale(&image, to_width, to_height, &mut by_kernel).unwrap();
            ops::resize(&view, to_width, to_height, &mut by_host).unwrap();
            assert_eq!(by_kernel, by_host, "{what} to {to_width}x{to_height}");
        });
    }
}

#[test]
fn the_maximum_size_of_an_image_is_that_of_the_host() {
    assert_eq!(kernels::MAX_SIDE, pixels::MAX_SIDE);
}
