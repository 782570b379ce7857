//! Makes the calls that the bytes of a sample list, with arbitrary arguments: the host must not be
//! harmed.
//!
//! A program is a list of steps (`test-support`): a byte for the call, then its arguments. The
//! results of calls are held, and later steps use them by number, so that they occur in every
//! order. Bytes beyond the end of the program are 0. Refusals are expected; only an explicit step
//! panics.

use gleaner_sdk::data::{Frame, Roi};
use gleaner_sdk::inference::{DetectOptions, ElementType, Model, Placement, Preprocess, Tensor};
use gleaner_sdk::log::{error, trace, warn};
use gleaner_sdk::{
    Config, Field, Lambda, Result, Sample, Topic, event, input, inputs, now_ns, scratch, start,
    stop,
};
use gleaner_test_support::operations::{DriverStep, Extra, Operation};

/// Maximum number of steps in a wake: more would only burn its fuel.
const STEPS: usize = 256;
/// Maximum length of a text in bytes. The host accepts 1 MiB.
const TEXT: usize = 2 << 20;

#[derive(Default)]
struct HeldObjects {
    topics: Vec<Topic>,
    fields: Vec<Field>,
    samples: Vec<Sample>,
    frames: Vec<Frame>,
    tensors: Vec<Tensor>,
    models: Vec<Model>,
}

struct ProgramDriver {
    held: HeldObjects,
}

impl Lambda for ProgramDriver {
    fn init(_: &Config) -> Result<Self> {
        Ok(Self { held: HeldObjects::default() })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let program = sample.cdr(4, u32::MAX);
        let mut bytes = Bytes(&program);
        self.held.samples.push(sample);
        for _ in 0..STEPS {
            if bytes.0.is_empty() {
                break;
            }
            self.held.step(&mut bytes);
        }
        Ok(())
    }
}

impl HeldObjects {
    fn step(&mut self, bytes: &mut Bytes) {
        match DriverStep::of(bytes.u8()) {
            DriverStep::Call(operation) => self.call(operation, bytes),
            DriverStep::Extra(extra) => self.extra(extra, bytes),
        }
    }

    #[expect(clippy::too_many_lines, reason = "one short arm for each operation")]
    fn call(&mut self, operation: Operation, bytes: &mut Bytes) {
        match operation {
            Operation::Input => self.topics.extend(match bytes.u8() % 4 {
                3 => input(&bytes.text()),
                number => input(["program", "raw", "coded"][usize::from(number)]),
            }),
            Operation::Inputs => drop(inputs()),
            Operation::NowNs => drop(now_ns()),
            Operation::Name => drop(of(&self.topics, bytes).map(Topic::name)),
            Operation::RosTopic => drop(of(&self.topics, bytes).map(Topic::ros_topic)),
            Operation::TypeName => drop(of(&self.topics, bytes).map(Topic::type_name)),
            Operation::TopicCounts => drop(of(&self.topics, bytes).map(Topic::counts)),
            Operation::Newest => {
                self.samples.extend(of(&self.topics, bytes).and_then(Topic::newest))
            }
            Operation::Last => {
                keep(&mut self.samples, of(&self.topics, bytes).map(|it| it.last(bytes.u32())))
            }
            Operation::Since => {
                keep(&mut self.samples, of(&self.topics, bytes).map(|it| it.since(bytes.i64())))
            }
            Operation::Field => self.fields.extend(of(&self.topics, bytes).and_then(|it| {
                match bytes.u8() % 2 {
                    0 => it.field(bytes.path()),
                    _ => it.field(&bytes.text()),
                }
                .ok()
            })),
            Operation::Column => {
                drop(self.both(bytes).map(|(topic, field)| topic.column(field, bytes.u32())))
            }
            Operation::ColumnSince => {
                drop(self.both(bytes).map(|(topic, field)| topic.column_since(field, bytes.i64())));
            }
            Operation::FieldPath => drop(of(&self.fields, bytes).map(Field::path)),
            Operation::SampleIdentity => drop(of(&self.samples, bytes).map(Sample::identity)),
            Operation::SampleStamps => drop(of(&self.samples, bytes).map(Sample::stamps)),
            Operation::Size => drop(of(&self.samples, bytes).map(Sample::size)),
            Operation::BigEndian => drop(of(&self.samples, bytes).map(Sample::big_endian)),
            Operation::Get => drop(self.reading(bytes).map(|(sample, field)| sample.get(field))),
            Operation::Number => {
                drop(self.reading(bytes).map(|(sample, field)| sample.number(field)))
            }
            Operation::Cdr => {
                drop(of(&self.samples, bytes).map(|it| it.cdr(bytes.u64(), bytes.u32())))
            }
            Operation::AsFrame => {
                self.frames.extend(of(&self.samples, bytes).and_then(|it| it.as_frame().ok()))
            }
            Operation::Info => drop(of(&self.frames, bytes).map(Frame::info)),
            Operation::FrameIdentity => drop(of(&self.frames, bytes).map(Frame::identity)),
            Operation::FrameStamps => drop(of(&self.frames, bytes).map(Frame::stamps)),
            Operation::MeanLuma => {
                drop(of(&self.frames, bytes).map(|it| it.mean_luma(bytes.roi())))
            }
            Operation::Histogram => {
                drop(of(&self.frames, bytes).map(|it| it.histogram(bytes.roi())))
            }
            Operation::Resize => self.frames.extend(of(&self.frames, bytes).and_then(|it| {
                let [width, height] = bytes.size();
                it.resize(width, height).ok()
            })),
            Operation::ToGray => {
                self.frames.extend(of(&self.frames, bytes).and_then(|it| it.to_gray().ok()))
            }
            Operation::Read => {
                drop(of(&self.frames, bytes).map(|it| it.read(bytes.u64(), bytes.u32())))
            }
            Operation::Event => drop(event(&bytes.text(), bytes.f64()).send()),
            Operation::Start => drop(start(&bytes.text()).with("k", bytes.u8() > 0).send()),
            Operation::Stop => drop(stop(&bytes.text())),
            Operation::Log => [error, warn, trace][usize::from(bytes.u8() % 3)](&bytes.text()),
            Operation::TensorCreate => {
                self.tensors.extend(Tensor::create(bytes.element(), &bytes.shape()))
            }
            Operation::FromFrame => {
                let made =
                    of(&self.frames, bytes).map(|it| Tensor::from_frame(it, bytes.preprocess()));
                self.tensors.extend(made.and_then(Result::ok));
            }
            Operation::Element => drop(of(&self.tensors, bytes).map(Tensor::element)),
            Operation::Shape => drop(of(&self.tensors, bytes).map(Tensor::shape)),
            Operation::TensorSize => drop(of(&self.tensors, bytes).map(Tensor::size)),
            Operation::TensorRead => {
                drop(of(&self.tensors, bytes).map(|it| it.read(bytes.u64(), bytes.u32())))
            }
            Operation::TensorWrite => drop(
                of(&self.tensors, bytes)
                    .map(|it| it.write(bytes.u64(), &vec![1; bytes.u32() as usize % TEXT])),
            ),
            Operation::Open => self.models.extend(Model::open(&bytes.text())),
            Operation::ModelInputs => drop(of(&self.models, bytes).map(Model::inputs)),
            Operation::ModelOutputs => drop(of(&self.models, bytes).map(Model::outputs)),
            Operation::Labels => drop(of(&self.models, bytes).map(Model::labels)),
            Operation::Runtime => drop(of(&self.models, bytes).map(Model::runtime)),
            Operation::Run => {
                let name = bytes.text();
                let inputs: Vec<_> =
                    of(&self.tensors, bytes).map(|it| (name.as_str(), it)).into_iter().collect();
                drop(of(&self.models, bytes).map(|it| it.run(&inputs)));
            }
            Operation::Detect => {
                let (frame, classes) = (of(&self.frames, bytes), vec![bytes.text()]);
                let (min_score, max_iou, max_count) = (0.0, f32::NAN, bytes.u32());
                let options = DetectOptions { classes, min_score, max_iou, max_count };
                drop(
                    of(&self.models, bytes)
                        .zip(frame)
                        .map(|(it, frame)| it.detect(frame, &options)),
                );
            }
            Operation::ScratchPut => {
                drop(scratch::put(bytes.name(), &vec![1; bytes.u32() as usize % TEXT]))
            }
            Operation::Append => {
                drop(scratch::append(bytes.name(), &vec![2; usize::from(bytes.u16())]))
            }
            Operation::ScratchGet => drop(scratch::get(bytes.name(), bytes.u64(), bytes.u32())),
            Operation::Remove => drop(scratch::remove(bytes.name())),
            Operation::Entries => drop(scratch::entries()),
            Operation::Free => drop(scratch::free()),
        }
    }

    fn extra(&mut self, extra: Extra, bytes: &mut Bytes) {
        match extra {
            Extra::Reset => *self = Self::default(),
            Extra::ForgetTopic => forget(&mut self.topics, bytes),
            Extra::ForgetField => forget(&mut self.fields, bytes),
            Extra::ForgetSample => forget(&mut self.samples, bytes),
            Extra::ForgetFrame => forget(&mut self.frames, bytes),
            Extra::ForgetTensor => forget(&mut self.tensors, bytes),
            Extra::EventWithTexts => {
                drop(
                    event("e", 0.5)
                        .with(&bytes.text(), bytes.f64())
                        .with(&bytes.text(), &*bytes.text())
                        .send(),
                );
            }
            Extra::EventWithMany => {
                let many = (0..bytes.u8())
                    .fold(event("many", 1.0), |event, key| event.with(&key.to_string(), i64::MIN));
                drop(many.send());
            }
            Extra::ColumnAtOnce => {
                drop(
                    of(&self.topics, bytes).map(|it| it.column(&it.field(bytes.path())?, u32::MAX)),
                );
            }
            Extra::ScratchPutText => drop(scratch::put(&bytes.text(), b"")),
            Extra::Print => println!("{}", bytes.text()),
            Extra::PrintError => eprint!("{}", bytes.text()),
            Extra::Allocate => {
                drop(std::hint::black_box(vec![0_u8; bytes.u32() as usize % (8 << 20)]))
            }
            Extra::Wasi => {
                drop((std::fs::read("/"), std::time::SystemTime::now(), std::time::Instant::now()))
            }
            Extra::Panic if bytes.u8() == 0xba => panic!("{}", bytes.text()),
            Extra::Exit if bytes.u8() == 0xba => std::process::exit(i32::from(bytes.u8())),
            Extra::Panic | Extra::Exit => {}
        }
    }

    fn both(&self, bytes: &mut Bytes) -> Option<(&Topic, &Field)> {
        Some((of(&self.topics, bytes)?, of(&self.fields, bytes)?))
    }

    fn reading(&self, bytes: &mut Bytes) -> Option<(&Sample, &Field)> {
        Some((of(&self.samples, bytes)?, of(&self.fields, bytes)?))
    }
}

fn of<'a, T>(held: &'a [T], bytes: &mut Bytes) -> Option<&'a T> {
    let number = usize::from(bytes.u8());
    held.get(number.checked_rem(held.len())?)
}

fn keep<T>(held: &mut Vec<T>, more: Option<impl Iterator<Item = T>>) {
    held.extend(more.into_iter().flatten());
}

fn forget<T>(held: &mut Vec<T>, bytes: &mut Bytes) {
    let number = usize::from(bytes.u8());
    if let Some(number) = number.checked_rem(held.len()) {
        held.swap_remove(number);
    }
}

/// Splits a program into numbers and texts, front to back.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn array<const N: usize>(&mut self) -> [u8; N] {
        let mut array = [0; N];
        let (bytes, rest) = self.0.split_at(N.min(self.0.len()));
        array[..bytes.len()].copy_from_slice(bytes);
        self.0 = rest;
        array
    }

    fn u8(&mut self) -> u8 {
        self.array::<1>()[0]
    }

    fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.array())
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.array())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.array())
    }

    fn i64(&mut self) -> i64 {
        i64::from_le_bytes(self.array())
    }

    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.array())
    }

    /// A few bytes as text; or one letter, repeated beyond all limits.
    fn text(&mut self) -> String {
        match self.u8() {
            255 => "x".repeat(self.u32() as usize % TEXT),
            length => (0..length.min(40)).map(|_| char::from(self.u8())).collect(),
        }
    }

    fn name(&mut self) -> &'static str {
        ["a", "b", "c", "", "not\nthere"][usize::from(self.u8() % 5)]
    }

    fn path(&mut self) -> &'static str {
        let paths = [
            "data",
            "data[3]",
            "width",
            "header.frame_id",
            "header.stamp.sec",
            "format",
            "step",
            "encoding",
        ];
        paths[usize::from(self.u8()) % paths.len()]
    }

    fn roi(&mut self) -> Option<Roi> {
        match self.u8() % 3 {
            0 => None,
            1 => Some(Roi { x: self.u32(), y: self.u32(), width: self.u32(), height: self.u32() }),
            _ => {
                let mut side = || u32::from(self.u8());
                Some(Roi { x: side(), y: side(), width: side(), height: side() })
            }
        }
    }

    fn size(&mut self) -> [u32; 2] {
        match self.u8() % 2 {
            0 => [self.u8().into(), self.u8().into()],
            _ => [self.u32(), self.u32()],
        }
    }

    fn shape(&mut self) -> Vec<u32> {
        match self.u8() % 3 {
            0 => vec![self.u8().into(), self.u8().into()],
            1 => vec![self.u32(), self.u32()],
            _ => vec![1; usize::from(self.u8())],
        }
    }

    fn element(&mut self) -> ElementType {
        let elements = [
            ElementType::Float32,
            ElementType::Float16,
            ElementType::Float64,
            ElementType::Int8,
            ElementType::Int16,
            ElementType::Int32,
            ElementType::Int64,
            ElementType::Uint8,
            ElementType::Boolean,
        ];
        elements[usize::from(self.u8()) % elements.len()]
    }

    fn preprocess(&mut self) -> Preprocess {
        let ([width, height], flags) = (self.size(), self.u8());
        let placements = [Placement::Stretch, Placement::Centre, Placement::Corner];
        Preprocess {
            placement: placements[usize::from(flags) % placements.len()],
            fill: flags,
            bgr: flags & 4 != 0,
            channels_last: flags & 8 != 0,
            bytes: flags & 16 != 0,
            scale: if flags & 32 != 0 { f32::INFINITY } else { 1.0 },
            mean: (if flags & 64 != 0 { f32::NAN } else { 0.0 }, 1.0, 2.0),
            deviation: (1.0, 2.0, if flags & 128 != 0 { 0.0 } else { 3.0 }),
            ..Preprocess::new(width, height)
        }
    }
}

gleaner_sdk::lambda!(ProgramDriver);
