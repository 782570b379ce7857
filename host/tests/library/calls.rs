//! What a call into the host does in pieces is the same as in one, and ends when the lambda has to.

use std::sync::Arc;
use std::time::Instant;

use crate::greedy::{publish, subscribed};
use gleaner_host::api::Session;
use gleaner_host::api::data::{DataError, Topic};
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_tests::drive::{IMAGE, image};

const WIDTH: u32 = 701;
const HEIGHT: u32 = 900;
const STEP: u32 = 3 * WIDTH + 5;

/// Pixels of all levels: 1.9 MB, more than one piece.
fn pixels() -> Vec<u8> {
    let mut state = 7_u32;
    let noise = std::iter::repeat_with(|| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    });
    noise.take((STEP * HEIGHT) as usize).collect()
}

fn camera(cdr: &[u8]) -> Arc<Topic> {
    let manifest = "[lambda]\nname = \"x\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"x.wasm\"\n\
                    [schedule]\nevent = \"camera\"\n\
                    [[input]]\nname = \"camera\"\ntopic = \"/camera\"\ntype = \"sensor_msgs/msg/Image\"\nmax_size = \"4 MiB\"\n";
    let (mut transport, topic) = subscribed(&Manifest::parse(manifest, "lambda.toml").unwrap(), IMAGE);
    publish(&mut transport, "/camera", 1, cdr);
    topic
}

#[test]
fn a_histogram_and_a_grey_image_made_in_pieces_miss_no_row() {
    let pixels = pixels();
    let topic = camera(&image(WIDTH, HEIGHT, "rgb8", STEP, &pixels));
    let frame = topic.newest().unwrap().as_frame().unwrap();
    let grey = |x: u32, y: u32| {
        let at = (y * STEP + 3 * x) as usize;
        let [r, g, b] = [0, 1, 2].map(|channel| u32::from(pixels[at + channel]));
        ((299 * r + 587 * g + 114 * b) / 1000) as u8
    };
    let expected: Vec<u8> =
        (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x, y))).map(|(x, y)| grey(x, y)).collect();
    assert!(frame.to_gray().unwrap().bytes() == expected);
    let mut counts = [0_u32; 256];
    expected.iter().for_each(|level| counts[usize::from(*level)] += 1);
    assert_eq!(frame.histogram(None).unwrap(), counts);
}

#[test]
fn what_takes_long_ends_when_the_lambda_has_to() {
    let topic = camera(&image(WIDTH, HEIGHT, "rgb8", STEP, &pixels()));
    let session = Session::new(vec![Arc::clone(&topic)], Vec::new(), &Limits::default());
    let (sample, field) = (topic.newest().unwrap(), topic.field("encoding").unwrap());
    let frame = sample.as_frame().unwrap();
    let calls = || {
        [
            frame.mean_luma(None).map(drop),
            frame.histogram(None).map(drop),
            frame.to_gray().map(drop),
            frame.resize(640, 480).map(drop),
        ]
    };
    assert!(calls().iter().all(Result::is_ok));
    let due = session.due().unwrap();
    due.set(Some(Instant::now()));
    for refused in calls() {
        assert!(matches!(refused, Err(DataError::OutOfTime)), "{refused:?}");
    }
    // What is short is not asked.
    assert!(sample.get(&field).is_ok());
    due.set(None);
    assert!(calls().iter().all(Result::is_ok));
}
