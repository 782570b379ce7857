//! Synthetic sensors: a camera that sends noise, and an IMU at rest. For measurements, and for
//! tests of losses.
//!
//! The pixels of all frames are equal, in every run. `header.frame_id` of each message holds its
//! number, from 0, in ten digits, so that a reader can find gaps.

use gleaner_base::Failure;
use gleaner_messages::Endian;

use super::{MessageSource, PlayedTopic, Remaps};
use crate::args::{Args, Size, SyntheticCamera};
use crate::buffer::{Buffer, Pool};
use crate::cdr;
use crate::offer::Offer;
use crate::queue::QueuedMessage;

const IMAGES: &str = "/camera/synthetic/image_raw";
const IMU: &str = "/imu/synthetic";

const SEED: u64 = 0x676c_6561_6e65_7221;

pub(crate) struct Synthetic {
    topics: Vec<PlayedTopic>,
    sensors: Vec<SyntheticSensor>,
    until_ns: Option<i64>,
    pool: Pool,
}

struct SyntheticSensor {
    /// Size of its frames; `None` for the IMU.
    size: Option<Size>,
    hertz: f64,
    /// Number of its next message.
    next: u64,
}

impl SyntheticSensor {
    fn at_ns(&self) -> i64 {
        (self.next as f64 * 1e9 / self.hertz) as i64
    }
}

impl Synthetic {
    pub(crate) fn open(args: &Args) -> Result<Synthetic, Failure> {
        let mut remaps = Remaps::of(args);
        let mut topic = |topic: &'static str, type_name: &str| PlayedTopic {
            topic: remaps.take(topic).unwrap_or(topic).to_owned(),
            type_name: type_name.to_owned(),
            offer: Offer::default(),
            is_stamped: true,
        };
        let (mut topics, mut sensors) = (Vec::new(), Vec::new());
        if let Some(SyntheticCamera { size, hertz }) = args.synthetic {
            topics.push(topic(IMAGES, "sensor_msgs/msg/Image"));
            sensors.push(SyntheticSensor { size: Some(size), hertz, next: 0 });
        }
        if let Some(hertz) = args.imu {
            topics.push(topic(IMU, "sensor_msgs/msg/Imu"));
            sensors.push(SyntheticSensor { size: None, hertz, next: 0 });
        }
        remaps.check(&topics)?;
        Ok(Synthetic { topics, sensors, until_ns: args.duration, pool: Pool::default() })
    }

    fn frame(&self, number: u64, size: Size) -> Buffer {
        let head = cdr::image_head(0, &frame_id(number), size.width, size.height);
        let len = (head.len() + size.bytes()).next_multiple_of(4);
        let mut frame = self.pool.take(len);
        // A reused buffer already contains the noise.
        if frame.len() != len {
            frame.resize(len, 0);
            noise(&mut frame[head.len()..head.len() + size.bytes()]);
        }
        frame[..head.len()].copy_from_slice(&head);
        frame
    }
}

impl MessageSource for Synthetic {
    fn topics(&self) -> &[PlayedTopic] {
        &self.topics
    }

    fn next(&mut self) -> Result<Option<QueuedMessage>, Failure> {
        let Some(topic) = (0..self.sensors.len()).min_by_key(|index| self.sensors[*index].at_ns())
        else {
            return Ok(None);
        };
        let &SyntheticSensor { size, next, .. } = &self.sensors[topic];
        let at_ns = self.sensors[topic].at_ns();
        if self.until_ns.is_some_and(|until_ns| at_ns >= until_ns) {
            return Ok(None);
        }
        let bytes = size.map_or_else(|| imu(next).into(), |size| self.frame(next, size));
        self.sensors[topic].next += 1;
        Ok(Some(QueuedMessage { topic, at_ns, rounds_ns: 0, endian: Endian::Little, bytes }))
    }

    /// A few frames: making one is cheap.
    fn read_ahead(&self) -> usize {
        self.sensors
            .iter()
            .filter_map(|stream| stream.size)
            .map(|size| 4 * size.bytes())
            .sum::<usize>()
            + (256 << 10)
    }

    fn undecodable(&self, _topic: usize) -> u64 {
        0
    }
}

/// Returns `header.frame_id`. Its length is constant, so that the pixels of a reused frame stay in
/// place.
fn frame_id(number: u64) -> String {
    format!("{:010}", number % 10_000_000_000)
}

/// Fills `pixels` with the same noise each time: Marsaglia, "Xorshift RNGs", 2003.
fn noise(pixels: &mut [u8]) {
    let mut state = SEED;
    for chunk in pixels.chunks_mut(8) {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        chunk.copy_from_slice(&state.to_le_bytes()[..chunk.len()]);
    }
}

/// A `sensor_msgs/msg/Imu` at rest, with its z axis up.
fn imu(number: u64) -> Vec<u8> {
    let mut imu = cdr::with_header(0, &frame_id(number));
    let diagonal = |variance: f64| [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance];
    imu.f64s(&[0.0, 0.0, 0.0, 1.0]).f64s(&diagonal(1e-4));
    imu.f64s(&[0.0, 0.0, 0.0]).f64s(&diagonal(1e-6));
    imu.f64s(&[0.0, 0.0, 9.806_65]).f64s(&diagonal(1e-4));
    cdr::sealed(&imu)
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use gleaner_base::Exit;
    use gleaner_messages::{Definitions, FieldPath, ImageView, MessageValue, Sources};

    use super::*;

    fn open(arguments: &[&str]) -> Result<Synthetic, Failure> {
        Synthetic::open(&Args::try_parse_from(["gleaner-player"].iter().chain(arguments)).unwrap())
    }

    fn all(mut source: Synthetic) -> Vec<QueuedMessage> {
        std::iter::from_fn(|| source.next().unwrap()).collect()
    }

    #[test]
    fn an_imu_is_read_back_by_its_field_paths() {
        let text = Sources::default().find("sensor_msgs/msg/Imu").unwrap().unwrap();
        let definitions = Definitions::parse("sensor_msgs/msg/Imu", &text).unwrap();
        let messages = all(open(&["--imu", "100", "--duration", "1"]).unwrap());
        assert_eq!(messages.len(), 100);
        let cdr = &messages[42].bytes[4..];
        let number = |path: &str| {
            FieldPath::compile(&definitions, path).unwrap().number(cdr, Endian::Little).unwrap()
        };
        assert_eq!((number("orientation.w"), number("linear_acceleration.z")), (1.0, 9.806_65));
        assert_eq!(number("angular_velocity.x"), 0.0);
        assert_eq!(number("linear_acceleration_covariance[8]"), 1e-4);
        let path = FieldPath::compile(&definitions, "header.frame_id").unwrap();
        assert_eq!(path.read(cdr, Endian::Little).unwrap(), MessageValue::Text("0000000042"));
        assert_eq!(messages[42].at_ns, 420_000_000);
    }

    #[test]
    fn frames_have_equal_noise_and_a_number_each_also_in_reused_buffers() {
        let mut source = open(&["--synthetic", "33x7@30"]).unwrap();
        let mut first = None;
        for number in 0..20 {
            // Dropped at once, so that the next frame reuses its buffer.
            let message = source.next().unwrap().unwrap();
            let image = ImageView::read(&message.bytes[4..], Endian::Little).unwrap();
            assert_eq!(
                (image.width, image.height, image.step, image.encoding),
                (33, 7, 99, "bgr8")
            );
            assert_eq!(&message.bytes[16..26], format!("{number:010}").as_bytes());
            let pixels = first.get_or_insert_with(|| image.data.to_vec());
            assert_eq!((image.data.len(), image.data), (693, pixels.as_slice()));
            let kinds = (0..=u8::MAX).filter(|value| pixels.contains(value)).count();
            assert!(kinds > 200, "693 bytes of noise have most values: {kinds}");
        }
    }

    #[test]
    fn sensors_are_merged_by_time() {
        let messages =
            all(open(&["--synthetic", "4x4@10", "--imu", "40", "--duration", "0.3"]).unwrap());
        let topics: Vec<_> = messages.iter().map(|message| message.topic).collect();
        assert_eq!(topics, [0, 1, 1, 1, 1, 0, 1, 1, 1, 1, 0, 1, 1, 1, 1]);
        assert!(messages.is_sorted_by_key(|message| message.at_ns));
    }

    #[test]
    fn sensors_can_be_renamed_and_an_unknown_name_is_refused() {
        let both = ["--imu", "1", "--synthetic", "4x4@10", "--remap"];
        let remapped = |remap| open(&[&both[..], &[remap]].concat());
        let source = remapped("/camera/synthetic/image_raw:=/camera/rear/image_raw").unwrap();
        let names: Vec<_> = source.topics().iter().map(|topic| topic.topic.as_str()).collect();
        assert_eq!(names, ["/camera/rear/image_raw", "/imu/synthetic"]);
        for (remap, expected) in [
            ("/imu:=/car/imu", "`/imu`, which is not played"),
            ("/imu/synthetic:=/camera/synthetic/image_raw", "two topics"),
        ] {
            let failure = remapped(remap).err().expect("the name is refused");
            assert_eq!(failure.exit, Exit::Usage);
            assert!(failure.message.contains(expected), "{failure}");
        }
    }
}
