//! Calls into the host that work in pieces: the result is the same as in one piece, and they end at
//! the deadline of the lambda.

use std::sync::Arc;
use std::time::Duration;

use crate::greedy::publish;
use gleaner_host::api::Session;
use gleaner_host::api::call_time::CallTime;
use gleaner_host::api::data::{DataError, Field, Sample, Topic};
use gleaner_host::api::frame::Frame;
use gleaner_host::api::inference::{InferenceError, Model};
use gleaner_host::api::log::Level;
use gleaner_host::input::open_inputs;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_messages::transport::loopback::Loopback;
use gleaner_pixels::vision::{Placement, Preprocess};
use gleaner_protocol::inference::Element;
use gleaner_test_support::operations::{Deadline, Operation};
use gleaner_tests::drive::{COMPRESSED, IMAGE, compressed, image};

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

/// Data for calls: a large raw picture, a compressed one that is not decoded yet, and many small
/// samples.
struct HostedData {
    session: Session,
    topic: Arc<Topic>,
    field: Field,
    sample: Sample,
    coded: Sample,
    frame: Frame,
    many: Arc<Topic>,
    x: Field,
}

impl HostedData {
    fn new(raw: &[u8]) -> Self {
        let input = |name: &str, type_name: &str| {
            format!(
                "[[input]]\nname = \"{name}\"\ntopic = \"/{name}\"\ntype = \"sensor_msgs/msg/{type_name}\"\nmax_size = \"4 MiB\"\n"
            )
        };
        let lambda = "[lambda]\nname = \"x\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"x.wasm\"\n[schedule]\nevent = \"raw\"\n";
        let many = "[[input]]\nname = \"many\"\ntopic = \"/many\"\ntype = \"test_msgs/msg/Only\"\ndepth = 1024\nmax_size = \"16 B\"\n";
        let manifest =
            [lambda, &input("raw", "Image"), &input("coded", "CompressedImage"), many].concat();
        let manifest = Manifest::parse(&manifest, "lambda.toml").unwrap();
        let mut transport = Loopback::new();
        for (input, definition) in manifest.inputs.iter().zip([IMAGE, COMPRESSED, "uint8 x\n"]) {
            transport.add_topic(input.topic.as_str(), input.type_name.as_str(), definition);
        }
        let inputs = open_inputs(&manifest, &[], &mut transport).unwrap();
        let mut jpeg = Vec::new();
        jpeg_encoder::Encoder::new(&mut jpeg, 80)
            .encode(&[7; 64 * 48 * 3], 64, 48, jpeg_encoder::ColorType::Rgb)
            .unwrap();
        publish(&mut transport, "/raw", 1, raw);
        publish(&mut transport, "/coded", 1, &compressed(&jpeg));
        (1..=1024).for_each(|seq| publish(&mut transport, "/many", seq, &[7]));
        let session = Session::new(inputs.clone(), Vec::new(), &Limits::default());
        session.begin(1);
        let [topic, coded, many] = [0, 1, 2].map(|input| Arc::clone(&inputs[input]));
        let (field, x) = (topic.field("width").unwrap(), many.field("x").unwrap());
        let (sample, coded) = (topic.newest().unwrap().unwrap(), coded.newest().unwrap().unwrap());
        let frame = sample.as_frame().unwrap();
        Self { session, topic, field, sample, coded, frame, many, x }
    }

    /// Calls an operation; returns the part of its result that the deadline can change.
    fn call(&self, operation: Operation) -> Result<(), DataError> {
        let Self { session, topic, field, sample, coded, frame, many, x } = self;
        let tensors = session.tensors();
        let tensor = || tensors.create(Element::Float32, &[2, 2]).unwrap();
        match operation {
            Operation::Input => session.input("raw").map(drop),
            Operation::Inputs => session.input_names().map(drop).map_err(DataError::from),
            Operation::NowNs => answered(session.now_ns()),
            Operation::Name => answered(topic.name()),
            Operation::RosTopic => answered(topic.ros_topic()),
            Operation::TypeName => answered(topic.type_name()),
            Operation::TopicCounts => answered(topic.counts()),
            Operation::Newest => answered(topic.newest()),
            Operation::Last => topic.last(9).map(drop),
            Operation::Since => topic.since(0).map(drop),
            Operation::Field => topic.field("encoding").map(drop),
            Operation::Column => many.column(x, usize::MAX).map(drop),
            Operation::ColumnSince => many.column_since(x, 0).map(drop),
            Operation::FieldPath => answered(field.path()),
            Operation::SampleIdentity => answered(sample.identity()),
            Operation::SampleStamps => answered(sample.stamps()),
            Operation::Size => answered(sample.bytes().len()),
            Operation::BigEndian => answered(sample.big_endian()),
            Operation::Get => sample.get(field).map(drop),
            Operation::Number => sample.number(field).map(drop),
            Operation::Cdr => sample.cdr(0, 1 << 20).map(drop),
            Operation::AsFrame => coded.as_frame().map(drop),
            Operation::Info => answered(frame.info()),
            Operation::FrameIdentity => answered(frame.identity()),
            Operation::FrameStamps => answered(frame.stamps()),
            Operation::MeanLuma => frame.mean_luma(None).map(drop),
            Operation::Histogram => frame.histogram(None).map(drop),
            Operation::Resize => frame.resize(640, 480).map(drop),
            Operation::ToGray => frame.to_gray().map(drop),
            Operation::Read => frame.read(0, 1 << 20).map(drop),
            Operation::Event => answered(session.event("e", 1.0, Vec::new())),
            Operation::Start => answered(session.start("s", Vec::new())),
            Operation::Stop => answered(session.stop("s")),
            Operation::Log => answered(session.log(Level::Info, "line")),
            Operation::TensorCreate => answered(tensors.create(Element::Int16, &[9])),
            Operation::FromFrame => {
                match tensors.of_frame(session.models(), frame, &preprocess()) {
                    Err(InferenceError::OutOfTime) => Err(DataError::OutOfTime),
                    other => other.map(drop).map_err(|error| panic!("{error}")),
                }
            }
            Operation::Element | Operation::Shape | Operation::TensorSize => {
                answered(tensor().content().clone())
            }
            Operation::TensorRead => answered(tensor().read(0, 9)),
            Operation::TensorWrite => answered(tensor().write(0, &[7])),
            Operation::Open => {
                answered(Model::open(session.models(), tensors, "no model of the manifest"))
            }
            // The tests of gleaner-inference call them.
            Operation::ModelInputs
            | Operation::ModelOutputs
            | Operation::Labels
            | Operation::Runtime
            | Operation::Run
            | Operation::Detect => Ok(()),
            Operation::ScratchPut => answered(session.put("a", b"bytes")),
            Operation::Append => answered(session.append("a", b"bytes")),
            Operation::ScratchGet => answered(session.get("a", 0, 9)),
            Operation::Remove => answered(session.remove("a")),
            Operation::Entries => answered(session.entries()),
            Operation::Free => answered(session.free()),
        }
    }
}

fn preprocess() -> Preprocess {
    Preprocess {
        width: 640,
        height: 640,
        placement: Placement::Centre,
        fill: 114,
        bgr: false,
        channels_last: false,
        bytes: false,
        scale: 1.0 / 255.0,
        mean: [0.0; 3],
        deviation: [1.0; 3],
    }
}

/// Discards a result that has no case for a deadline.
fn answered<T>(_: T) -> Result<(), DataError> {
    Ok(())
}

#[test]
fn a_histogram_and_a_grey_image_made_in_pieces_miss_no_row() {
    let pixels = pixels();
    let HostedData { frame, .. } = HostedData::new(&image(WIDTH, HEIGHT, "rgb8", STEP, &pixels));
    let grey = |x: u32, y: u32| {
        let at = (y * STEP + 3 * x) as usize;
        let [r, g, b] = [0, 1, 2].map(|channel| u32::from(pixels[at + channel]));
        ((299 * r + 587 * g + 114 * b) / 1000) as u8
    };
    let expected: Vec<u8> = (0..HEIGHT)
        .flat_map(|y| (0..WIDTH).map(move |x| (x, y)))
        .map(|(x, y)| grey(x, y))
        .collect();
    assert!(frame.to_gray().unwrap().bytes() == expected);
    let mut counts = [0_u32; 256];
    expected.iter().for_each(|level| counts[usize::from(*level)] += 1);
    assert_eq!(frame.histogram(None).unwrap(), counts);
}

#[test]
fn long_calls_end_at_the_deadline_of_the_lambda() {
    let picture = image(WIDTH, HEIGHT, "rgb8", STEP, &pixels());
    for operation in Operation::ALL {
        let data = HostedData::new(&picture);
        let due = data.session.due().unwrap();
        due.set(Some(CallTime::begin(Duration::ZERO)));
        let ended = matches!(data.call(*operation), Err(DataError::OutOfTime));
        // Short calls do not check the deadline.
        assert_eq!(ended, operation.deadline() == Deadline::Checked, "{}", operation.name());
        due.set(None);
        assert!(data.call(*operation).is_ok(), "{}", operation.name());
    }
}
