//! Sensors that are made up: a camera that sees noise, and an IMU at rest. For measurements and for
//! tests of losses.
//!
//! The pixels of all frames are equal, and equal in every run. Each message has its number, from 0,
//! in `header.frame_id`, ten digits long, so that a reader can tell what was lost.

use gleaner_base::Failure;
use gleaner_messages::Endian;

use super::{Renamed, Source, Topic};
use crate::args::{Args, Camera, Size};
use crate::buffer::{Buffer, Pool};
use crate::cdr;
use crate::offer::Offer;
use crate::queue::Message;

const IMAGES: &str = "/camera/synthetic/image_raw";
const IMU: &str = "/imu/synthetic";

/// Seed of the noise.
const SEED: u64 = 0x676c_6561_6e65_7221;

/// The sensors, merged by time.
pub(crate) struct Synthetic {
    topics: Vec<Topic>,
    streams: Vec<Stream>,
    until_ns: Option<i64>,
    pool: Pool,
}

/// One sensor.
struct Stream {
    /// The size of its frames; `None` for the IMU.
    size: Option<Size>,
    hertz: f64,
    /// The number of its next message.
    next: u64,
}

impl Stream {
    fn at_ns(&self) -> i64 {
        (self.next as f64 * 1e9 / self.hertz) as i64
    }
}

impl Synthetic {
    pub(crate) fn open(args: &Args) -> Result<Synthetic, Failure> {
        let mut renamed = Renamed::by(args);
        let mut topic = |topic: &'static str, type_name: &str| Topic {
            topic: renamed.take(topic).unwrap_or(topic).to_owned(),
            type_name: type_name.to_owned(),
            offer: Offer::default(),
            is_stamped: true,
        };
        let (mut topics, mut streams) = (Vec::new(), Vec::new());
        if let Some(Camera { size, hertz }) = args.synthetic {
            topics.push(topic(IMAGES, "sensor_msgs/msg/Image"));
            streams.push(Stream { size: Some(size), hertz, next: 0 });
        }
        if let Some(hertz) = args.imu {
            topics.push(topic(IMU, "sensor_msgs/msg/Imu"));
            streams.push(Stream { size: None, hertz, next: 0 });
        }
        renamed.check(&topics)?;
        Ok(Synthetic { topics, streams, until_ns: args.duration, pool: Pool::default() })
    }

    fn frame(&self, number: u64, size: Size) -> Buffer {
        let head = cdr::image_head(0, &frame_id(number), size.width, size.height);
        let len = (head.len() + size.bytes()).next_multiple_of(4);
        let mut frame = self.pool.take(len);
        // One that was used before has its noise already.
        if frame.len() != len {
            frame.resize(len, 0);
            noise(&mut frame[head.len()..head.len() + size.bytes()]);
        }
        frame[..head.len()].copy_from_slice(&head);
        frame
    }
}

impl Source for Synthetic {
    fn topics(&self) -> &[Topic] {
        &self.topics
    }

    fn next(&mut self) -> Result<Option<Message>, Failure> {
        let Some(topic) = (0..self.streams.len()).min_by_key(|index| self.streams[*index].at_ns())
        else {
            return Ok(None);
        };
        let &Stream { size, next, .. } = &self.streams[topic];
        let at_ns = self.streams[topic].at_ns();
        if self.until_ns.is_some_and(|until_ns| at_ns >= until_ns) {
            return Ok(None);
        }
        let bytes = size.map_or_else(|| imu(next).into(), |size| self.frame(next, size));
        self.streams[topic].next += 1;
        Ok(Some(Message { topic, at_ns, rounds_ns: 0, endian: Endian::Little, bytes }))
    }

    /// A few frames: they cost next to nothing to make.
    fn read_ahead(&self) -> usize {
        self.streams
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

/// Always of one length, so that a frame that is used again has its pixels in the same place.
fn frame_id(number: u64) -> String {
    format!("{:010}", number % 10_000_000_000)
}

/// Fills `pixels` with the same noise each time: a sequence after Marsaglia, "Xorshift RNGs", 2003.
fn noise(pixels: &mut [u8]) {
    let mut state = SEED;
    for chunk in pixels.chunks_mut(8) {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        chunk.copy_from_slice(&state.to_le_bytes()[..chunk.len()]);
    }
}

/// A `sensor_msgs/msg/Imu` that lies still, with its z axis up.
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
    use gleaner_messages::{Definitions, FieldPath, ImageView, Sources, Value};

    use super::*;

    fn open(arguments: &[&str]) -> Result<Synthetic, Failure> {
        Synthetic::open(&Args::try_parse_from(["gleaner-player"].iter().chain(arguments)).unwrap())
    }

    fn all(mut source: Synthetic) -> Vec<Message> {
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
        assert_eq!(path.read(cdr, Endian::Little).unwrap(), Value::Text("0000000042"));
        assert_eq!(messages[42].at_ns, 420_000_000);
    }

    #[test]
    fn frames_are_images_with_equal_noise_and_a_number_each_even_in_memory_that_is_used_again() {
        let mut source = open(&["--synthetic", "33x7@30"]).unwrap();
        let mut first = None;
        for number in 0..20 {
            // Dropped at once, so that the next frame is made in its memory.
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
    fn sensors_can_have_other_names_and_a_name_that_no_sensor_has_is_refused() {
        let both = ["--imu", "1", "--synthetic", "4x4@10", "--remap"];
        let remapped = |remap| open(&[&both[..], &[remap]].concat());
        let source = remapped("/camera/synthetic/image_raw:=/camera/rear/image_raw").unwrap();
        let names: Vec<_> = source.topics().iter().map(|topic| topic.topic.as_str()).collect();
        assert_eq!(names, ["/camera/rear/image_raw", "/imu/synthetic"]);
        for (remap, said) in [
            ("/imu:=/car/imu", "`/imu`, which is not played"),
            ("/imu/synthetic:=/camera/synthetic/image_raw", "two topics"),
        ] {
            let failure = remapped(remap).err().expect("it is refused");
            assert_eq!(failure.exit, Exit::Usage);
            assert!(failure.message.contains(said), "{failure}");
        }
    }
}
