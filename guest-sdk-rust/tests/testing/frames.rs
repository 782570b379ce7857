//! Frames in the fake host: pixels, slots and limits.

use gleaner_sdk::data::{DataErrorKind, Encoding, Roi};
use gleaner_sdk::testing::Message;
use gleaner_sdk::{Error, Frame, Result};

use super::lambda::{camera, on_event};

fn pixels(frame: Frame) -> (u32, u32, Encoding, Vec<u8>) {
    let info = frame.info();
    let mut bytes = vec![0; info.size as usize];
    frame.copy_to(&mut bytes).unwrap();
    (info.width, info.height, info.encoding, bytes)
}

#[test]
fn operations_read_the_pixels_and_errors_have_a_kind() {
    let mut run = on_event(camera(false, ""), |sample| {
        let frame = sample.as_frame()?;
        let right = Some(Roi { x: 1, y: 0, width: 9, height: 9 });
        assert_eq!(
            (frame.mean_luma(None)?, frame.mean_luma(right)?),
            (273.15 / 4.0, (149.685 + 18.15) / 2.0)
        );
        assert_eq!(
            [76, 149, 29, 18].map(|level: usize| frame.histogram(None).unwrap()[level]),
            [1; 4]
        );
        assert_eq!(pixels(frame.to_gray()?), (2, 2, Encoding::Mono8, vec![76, 149, 29, 18]));
        assert_eq!(
            pixels(frame.resize(1, 2)?),
            (1, 2, Encoding::Rgb8, vec![128, 128, 0, 5, 10, 143])
        );
        // Includes the padding between two rows, but not that after the last row.
        assert_eq!((frame.info().size, frame.read(5, 4)), (14, vec![0, 99, 99, 0]));
        let outside = frame.mean_luma(Some(Roi { x: 2, y: 0, width: 1, height: 1 }));
        for refused in [outside.map(drop), frame.resize(0, 1).map(drop)] {
            assert!(refused.unwrap_err().is(DataErrorKind::OutOfRange));
        }
        Ok(())
    });
    let data = [255, 0, 0, 0, 255, 0, 99, 99, 0, 0, 255, 10, 20, 30, 99, 99];
    let message = Message::image(2, 2, Encoding::Rgb8, data).with("step", 8_u32);
    run.deliver("camera", 0, message).unwrap();
    assert_eq!(run.faults().next(), None);

    let mut run = on_event(camera(false, ""), |sample| {
        assert!(sample.as_frame()?.mean_luma(None).unwrap_err().is(DataErrorKind::NotAFrame));
        Ok(())
    });
    run.deliver("camera", 0, Message::image(2, 1, Encoding::BayerRggb8, [1, 2])).unwrap();
    assert_eq!(run.faults().next(), None);

    let mut run = on_event(camera(false, ""), |sample| {
        let frame = sample.as_frame()?;
        let error = frame.resize(1, 1).map(drop).unwrap_err();
        assert!(error.to_string().contains("call `to_gray` first, or read its pixels"), "{error}");
        assert_eq!(pixels(frame.to_gray()?), (1, 1, Encoding::Mono8, vec![2]));
        Ok(())
    });
    run.deliver("camera", 0, Message::image(1, 1, Encoding::Mono16, [1, 2])).unwrap();
    assert_eq!(run.faults().next(), None);
}

#[test]
fn inconsistent_images_are_refused_with_the_message_of_the_host() {
    let mut run = on_event(camera(false, ""), |sample| sample.as_frame().map(drop));
    for (n, (width, height, step, name, bytes, why)) in (0..).zip([
        (4, 2, 11, "rgb8", 99, "image of 4x2 rgb8 has a step of 11 bytes; a row needs 12"),
        (4, 2, 12, "rgb8", 23, "image of 4x2 rgb8 with 12 bytes per row needs 24 bytes; it has 23"),
        (0, 2, 12, "rgb8", 99, "image size is 0x2; each side must be 1 to 65535"),
        (4, 2, 4, "x", 9, "encoding `x` is not supported; supported are rgb8, bgr8, 8UC3, "),
    ]) {
        let message = Message::new().with("width", width).with("height", height).with("step", step);
        let message =
            message.with("encoding", name).with("is_bigendian", 0).with("data", vec![0_u8; bytes]);
        let decisions = run.deliver("camera", n, message).unwrap();
        let fault = decisions[0].fault.as_ref().unwrap();
        let wanted = format!("a sample of `/camera` is not a readable image: {why}");
        assert!(fault.message.starts_with(&wanted), "{}", fault.message);
    }
}

#[test]
fn decoded_images_are_limited_by_slots_and_size_and_each_is_decoded_once() {
    let mut run = on_event(camera(true, "decoded_size = \"300 B\"\nhold = 1"), |sample| {
        let frames = [sample.as_frame()?, sample.as_frame()?];
        assert!(frames.iter().all(|frame| frame.info().encoding == Encoding::Rgb8));
        assert_eq!(frames[0].mean_luma(None)?, 9.0);
        assert_eq!(frames[0].read(0, 3), [9; 3]);
        Ok(())
    });
    let picture =
        |side: u32| Message::image(side, side, Encoding::Rgb8, vec![9; (3 * side * side) as usize]);
    run.deliver("camera", 0, picture(10)).unwrap();
    assert_eq!(run.faults().next(), None);
    run.deliver("camera", 1, picture(11)).unwrap();
    let fault = run.faults().next().unwrap();
    assert!(
        fault.message.contains("is too large: image has a size of 11x11 (363 bytes as rgb8)"),
        "{fault:?}"
    );
    let jpeg = run.deliver("camera", 2, Message::new().with("data", vec![0xff_u8, 0xd8])).unwrap();
    assert!(
        jpeg[0]
            .fault
            .as_ref()
            .unwrap()
            .message
            .contains("create the message with `Message::image`")
    );
    for (message, wanted) in [
        (Message::image(2, 2, Encoding::Mono8, vec![0; 4]), "it has 4 of mono8"),
        (
            Message::image(2, 2, Encoding::Rgb8, vec![0; 4]),
            "2x2 pixels of rgb8 have 12 bytes; it has 4",
        ),
    ] {
        let refused = run.deliver("camera", 3, message).unwrap_err().to_string();
        assert!(refused.contains(wanted), "{refused}");
    }
}

#[test]
fn frames_and_their_bytes_are_limited_and_released() {
    let mut run = on_event(camera(false, "[limits]\nframes = 3\nmemory = \"1 MiB\""), |sample| {
        let refused =
            |result: Result<Frame>| result.err().map(|error| (error.kind(), error.to_string()));
        let frame = sample.as_frame()?;
        let large = frame.resize(1000, 1000)?;
        assert_eq!(large.info().size, 1_000_000);
        let (kind, why) = refused(frame.resize(300, 300)).ok_or(Error::new("there is room"))?;
        assert_eq!(kind, Some(DataErrorKind::NoRoom.into()));
        assert!(
            why.contains("a new frame or tensor needs 90000 bytes, and 48576 are left"),
            "{why}"
        );
        let third = frame.to_gray()?;
        let (_, why) = refused(frame.to_gray()).ok_or(Error::new("there are four"))?;
        assert!(why.contains("the lambda holds 3 frames and tensors"), "{why}");
        drop((large, third));
        frame.resize(300, 300).map(drop)
    });
    for n in 0..3 {
        run.deliver("camera", n, Message::image(4, 4, Encoding::Mono8, vec![1; 16])).unwrap();
    }
    assert_eq!(run.faults().next(), None);
}
