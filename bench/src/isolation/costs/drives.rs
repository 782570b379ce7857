//! The recorded input: the IMU of the sample drive, alone, and beside generated frames.

use std::path::PathBuf;

use gleaner_tests::TempFolder;
use gleaner_tests::drive::{IMAGE, TopicMessages, image, of_topics};

/// Topics of the lambdas that are compared.
pub(super) const IMU: &str = "/imu/synthetic";
pub(super) const CAMERA: &str = "/camera/synthetic/image_raw";

/// Bytes of the pixels of a frame.
pub(super) const FRAME_BYTES: usize = 1920 * 1080 * 3;

/// Time between two frames.
const FRAME_NS: u64 = 100_000_000;

/// A frame of 1920x1080 bgr8, as CDR. It is bright: a lambda that looks for the dark looks at each.
pub(super) fn frame() -> Vec<u8> {
    image(1920, 1080, "bgr8", 5760, &vec![99; FRAME_BYTES])
}

/// A drive with the IMU of the sample drive as `imu`, and `frames` on `camera`, the first one after
/// `imu_before` samples.
pub(super) fn with_frames(
    folder: &TempFolder,
    [imu, camera]: [&str; 2],
    imu_before: usize,
    frames: u64,
) -> PathBuf {
    let mut samples = TopicMessages { topic: imu.to_owned(), ..TopicMessages::sample_imu() };
    let first_ns = samples.messages[imu_before].0 + 1;
    let frame = frame();
    let frames: Vec<_> =
        (0..frames).map(|index| (first_ns + index * FRAME_NS, frame.clone())).collect();
    let end_ns = frames.last().map_or(0, |(at_ns, _)| *at_ns);
    samples.messages.retain(|(at_ns, _)| *at_ns < end_ns);
    let images = TopicMessages {
        topic: camera.to_owned(),
        type_name: "sensor_msgs/msg/Image".to_owned(),
        schema: IMAGE.to_owned(),
        messages: frames,
    };
    of_topics(folder, &[samples, images])
}
