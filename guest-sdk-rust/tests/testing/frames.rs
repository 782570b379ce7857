use std::cell::RefCell;

use gleaner_image::{Encoding as HostEncoding, ImageError, ImageErrorKind, Roi as HostRoi, View, ops};
use gleaner_sdk::data::{Encoding, Roi, bytes_per_pixel, encoding_name};
use gleaner_sdk::testing::Message;
use gleaner_sdk::{Error, Frame, Result, Sample};

use super::lambda::{camera, on_event};

const ENCODINGS: [Encoding; 16] = [
    Encoding::Rgb8,
    Encoding::Bgr8,
    Encoding::Rgba8,
    Encoding::Bgra8,
    Encoding::Mono8,
    Encoding::Mono16,
    Encoding::Yuv422,
    Encoding::Yuv422Yuy2,
    Encoding::BayerRggb8,
    Encoding::BayerBggr8,
    Encoding::BayerGbrg8,
    Encoding::BayerGrbg8,
    Encoding::BayerRggb16,
    Encoding::BayerBggr16,
    Encoding::BayerGbrg16,
    Encoding::BayerGrbg16,
];

/// Numbers that look random and are the same in every run.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as u32
    }

    /// From 1 to `most`.
    fn up_to(&mut self, most: u32) -> u32 {
        1 + self.next() % most
    }
}

/// A picture, a region of it, and a size for another.
#[derive(Clone)]
struct Case {
    size: (u32, u32),
    step: u32,
    encoding: Encoding,
    big_endian: bool,
    data: Vec<u8>,
    roi: Roi,
    to: (u32, u32),
}

impl Case {
    fn new(noise: &mut Noise, encoding: Encoding) -> Self {
        let (width, height) = (2 * noise.up_to(20), noise.up_to(20));
        let step = width * bytes_per_pixel(encoding) + noise.next() % 5;
        let data = (0..step * height).map(|_| noise.next() as u8).collect();
        let roi = Roi {
            x: noise.next() % (width + 2),
            y: noise.next() % (height + 1),
            width: noise.next() % 30,
            height: noise.up_to(30),
        };
        let to = (noise.next() % 60, noise.up_to(40));
        Self { size: (width, height), step, encoding, big_endian: noise.next().is_multiple_of(2), data, roi, to }
    }

    fn message(&self) -> Message {
        let (width, height) = self.size;
        let message = Message::image(width, height, self.encoding, self.data.clone());
        message.with("step", self.step).with("is_bigendian", u8::from(self.big_endian))
    }

    fn view(&self) -> View<'_> {
        let encoding = HostEncoding::from_ros(encoding_name(self.encoding)).unwrap();
        View::new(self.size.0, self.size.1, self.step, encoding, self.big_endian, &self.data).unwrap()
    }
}

thread_local! {
    static CASE: RefCell<Option<Case>> = const { RefCell::new(None) };
}

/// A result of the host as a lambda gets it: of refusals, the kind.
fn told<T>(result: std::result::Result<T, ImageError>) -> std::result::Result<T, &'static str> {
    result.map_err(|error| match error.kind() {
        ImageErrorKind::OutOfRange => "out-of-range",
        ImageErrorKind::Unreadable => "not-a-frame",
        ImageErrorKind::Stopped => unreachable!("nobody stops it"),
    })
}

fn kind<T>(result: Result<T>) -> std::result::Result<T, &'static str> {
    result.map_err(|error| error.kind().unwrap_or("none"))
}

fn pixels(frame: Frame) -> (u32, u32, Encoding, Vec<u8>) {
    let info = frame.info();
    let mut bytes = vec![0; info.size as usize];
    frame.copy_to(&mut bytes).unwrap();
    (info.width, info.height, info.encoding, bytes)
}

fn compare(sample: Sample) -> Result<()> {
    let case = CASE.with_borrow(Clone::clone).ok_or(Error::new("no case"))?;
    let (frame, view) = (sample.as_frame()?, case.view());
    let Roi { x, y, width, height } = case.roi;
    let what = format!("{:?} {:?} to {:?}, region {:?}", case.size, case.encoding, case.to, case.roi);
    for (roi, host) in [(None, None), (Some(case.roi), Some(HostRoi { x, y, width, height }))] {
        assert_eq!(kind(frame.mean_luma(roi)), told(ops::mean_luma(&view, host)), "{what}");
        assert_eq!(kind(frame.histogram(roi)), told(ops::histogram(&view, host).map(Vec::from)), "{what}");
    }
    let mut gray = vec![0; (case.size.0 * case.size.1) as usize];
    let made = told(ops::to_gray(&view, &mut gray)).map(|()| (case.size.0, case.size.1, Encoding::Mono8, gray));
    assert_eq!(kind(frame.to_gray().map(pixels)), made, "{what}");
    let resized = told(ops::resized(&view, case.to.0, case.to.1)).map(|(encoding, bytes)| {
        let mut out = vec![0; bytes];
        ops::resize(&view, case.to.0, case.to.1, &mut out).unwrap();
        let encoding = if encoding == HostEncoding::Mono8 { Encoding::Mono8 } else { Encoding::Rgb8 };
        (case.to.0, case.to.1, encoding, out)
    });
    assert_eq!(kind(frame.resize(case.to.0, case.to.1).map(pixels)), resized, "{what}");
    let last_row = case.size.0 * bytes_per_pixel(case.encoding);
    assert_eq!(frame.info().size, u64::from(case.step * (case.size.1 - 1) + last_row));
    assert_eq!(frame.read(3, 7), case.data[3..10]);
    Ok(())
}

#[test]
fn operations_on_pixels_are_those_of_the_host_bit_for_bit() {
    let mut noise = Noise(4);
    let mut run = on_event(camera(false, ""), compare);
    for (n, encoding) in (0..).zip(ENCODINGS.iter().cycle().take(16 * 25)) {
        let case = Case::new(&mut noise, *encoding);
        // Some are too small for what is read of them above.
        if case.data.len() < 16 {
            continue;
        }
        let message = case.message();
        CASE.set(Some(case));
        run.deliver("camera", n, message).unwrap();
        assert_eq!(run.faults().next(), None);
    }
    assert!(run.decisions().len() > 300);
}

#[test]
fn pictures_that_contradict_themselves_are_refused_in_the_hosts_words() {
    let mut run = on_event(camera(false, ""), |sample| sample.as_frame().map(drop));
    let refused = |width, height, step, name: &str, bytes: usize| {
        let encoding = HostEncoding::from_ros(name);
        let data = vec![0; bytes];
        encoding.and_then(|encoding| View::new(width, height, step, encoding, false, &data).map(drop)).unwrap_err()
    };
    let cases = [
        (4, 2, 11, "rgb8", 99),
        (4, 2, 12, "rgb8", 23),
        (0, 2, 12, "rgb8", 99),
        (3, 2, 6, "yuv422", 99),
        (4, 2, 4, "x", 9),
    ];
    for (n, (width, height, step, name, bytes)) in (0..).zip(cases) {
        let message = Message::new().with("width", width).with("height", height).with("step", step);
        let message = message.with("encoding", name).with("is_bigendian", 0).with("data", vec![0_u8; bytes]);
        let decisions = run.deliver("camera", n, message).unwrap();
        let fault = decisions[0].fault.as_ref().unwrap();
        let why = refused(width as u32, height as u32, step as u32, name, bytes);
        assert_eq!(fault.message, format!("a sample of `/camera` is no image that can be read: {why}"));
    }
}

#[test]
fn decoded_pictures_have_slots_and_a_size_and_each_is_decoded_once() {
    let mut run = on_event(camera(true, "decoded_size = \"300 B\"\nhold = 1"), |sample| {
        let frames = [sample.as_frame()?, sample.as_frame()?];
        assert!(frames.iter().all(|frame| frame.info().encoding == Encoding::Rgb8));
        assert_eq!(frames[0].mean_luma(None)?, 9.0);
        assert_eq!(frames[0].read(0, 3), [9; 3]);
        Ok(())
    });
    let picture = |side: u32| Message::image(side, side, Encoding::Rgb8, vec![9; (3 * side * side) as usize]);
    run.deliver("camera", 0, picture(10)).unwrap();
    assert_eq!(run.faults().next(), None);
    run.deliver("camera", 1, picture(11)).unwrap();
    let fault = run.faults().next().unwrap();
    assert!(fault.message.contains("is too large: image says it is 11x11 (363 bytes as rgb8)"), "{fault:?}");
    let jpeg = run.deliver("camera", 2, Message::new().with("data", vec![0xff_u8, 0xd8])).unwrap();
    assert!(jpeg[0].fault.as_ref().unwrap().message.contains("make the message with `Message::image`"));
    for (message, wanted) in [
        (Message::image(2, 2, Encoding::Mono8, vec![0; 4]), "it has 4 of mono8"),
        (Message::image(2, 2, Encoding::Rgb8, vec![0; 4]), "2x2 pixels of rgb8 have 12 bytes; it has 4"),
    ] {
        let refused = run.deliver("camera", 3, message).unwrap_err().to_string();
        assert!(refused.contains(wanted), "{refused}");
    }
}

#[test]
fn frames_and_their_bytes_are_bounded_and_given_back() {
    let mut run = on_event(camera(false, "[limits]\nframes = 3\nmemory = \"1 MiB\""), |sample| {
        let refused = |result: Result<Frame>| result.err().map(|error| (error.kind(), error.to_string()));
        let frame = sample.as_frame()?;
        let large = frame.resize(1000, 1000)?;
        assert_eq!(large.info().size, 1_000_000);
        let (kind, why) = refused(frame.resize(300, 300)).ok_or(Error::new("there is room"))?;
        assert_eq!(kind, Some("no-room"));
        assert!(why.contains("90000 bytes for a new frame, 48576 are left"), "{why}");
        let third = frame.to_gray()?;
        let (_, why) = refused(frame.to_gray()).ok_or(Error::new("there are four"))?;
        assert!(why.contains("the lambda holds 3 frames"), "{why}");
        drop((large, third));
        frame.resize(300, 300).map(drop)
    });
    for n in 0..3 {
        run.deliver("camera", n, Message::image(4, 4, Encoding::Mono8, vec![1; 16])).unwrap();
    }
    assert_eq!(run.faults().next(), None);
}
