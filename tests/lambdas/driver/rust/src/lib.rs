//! A lambda that makes the calls which the bytes of a sample say, with whatever arguments: the host must stay whole.
//!
//! A program is a list of steps: a byte for the call, then what it takes. What a call gives is kept, and later steps take from it by
//! number, so that they come in every order. What is missing at the end of the bytes is 0. Refusals are expected; a step that says so
//! ends in a panic instead.

use gleaner_sdk::data::{Frame, Roi};
use gleaner_sdk::inference::{Model, Preprocess, Tensor};
use gleaner_sdk::log::{error, trace, warn};
use gleaner_sdk::{Config, Field, Lambda, Result, Sample, Topic, event, input, inputs, now_ns, scratch, start, stop};

/// Steps of one wake: more would only use up its fuel.
const STEPS: usize = 256;
/// Most that is said in one call, in bytes. The host takes 1 MiB.
const TEXT: usize = 2 << 20;

#[derive(Default)]
struct Kept {
    topics: Vec<Topic>,
    fields: Vec<Field>,
    samples: Vec<Sample>,
    frames: Vec<Frame>,
}

struct Driver {
    kept: Kept,
}

impl Lambda for Driver {
    fn init(_: &Config) -> Result<Self> {
        Ok(Self { kept: Kept::default() })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let program = sample.cdr(4, u32::MAX);
        let mut bytes = Bytes(&program);
        self.kept.samples.push(sample);
        for _ in 0..STEPS {
            if bytes.0.is_empty() {
                break;
            }
            self.kept.step(&mut bytes);
        }
        Ok(())
    }
}

impl Kept {
    fn step(&mut self, bytes: &mut Bytes) {
        match bytes.u8() % 54 {
            0 => self.topics.extend(input(["program", "raw", "coded"][usize::from(bytes.u8() % 3)])),
            1 => self.topics.extend(input(&bytes.text())),
            2 => drop(inputs()),
            3 => drop(now_ns()),
            4 => drop(of(&self.topics, bytes).map(|it| (it.name(), it.ros_topic(), it.type_name(), it.counts()))),
            5 => self.samples.extend(of(&self.topics, bytes).and_then(Topic::newest)),
            6 => keep(&mut self.samples, of(&self.topics, bytes).map(|it| it.last(bytes.u32()))),
            7 => keep(&mut self.samples, of(&self.topics, bytes).map(|it| it.since(bytes.i64()))),
            8 => self.fields.extend(of(&self.topics, bytes).and_then(|it| it.field(&bytes.text()).ok())),
            9 => self.fields.extend(of(&self.topics, bytes).and_then(|it| it.field(bytes.path()).ok())),
            10 => drop(self.both(bytes).map(|(topic, field)| topic.column(field, bytes.u32()))),
            11 => drop(self.both(bytes).map(|(topic, field)| topic.column_since(field, bytes.i64()))),
            12 => drop(of(&self.fields, bytes).map(Field::path)),
            13 => drop(of(&self.samples, bytes).map(|it| (it.identity(), it.stamps(), it.size(), it.big_endian()))),
            14 => drop(self.reading(bytes).map(|(sample, field)| sample.get(field))),
            15 => drop(self.reading(bytes).map(|(sample, field)| sample.number(field))),
            16 => drop(of(&self.samples, bytes).map(|it| it.cdr(bytes.u64(), bytes.u32()))),
            17..=19 => self.frames.extend(of(&self.samples, bytes).and_then(|it| it.as_frame().ok())),
            20 => drop(of(&self.frames, bytes).map(|it| (it.info(), it.identity(), it.stamps()))),
            21 => drop(of(&self.frames, bytes).map(|it| it.mean_luma(bytes.roi()))),
            22 => drop(of(&self.frames, bytes).map(|it| it.histogram(bytes.roi()))),
            23 => self.frames.extend(of(&self.frames, bytes).and_then(|it| it.resize(bytes.u32(), bytes.u32()).ok())),
            24 => {
                let side = |bytes: &mut Bytes| u32::from(bytes.u8());
                self.frames.extend(of(&self.frames, bytes).and_then(|it| it.resize(side(bytes), side(bytes)).ok()));
            }
            25 => self.frames.extend(of(&self.frames, bytes).and_then(|it| it.to_gray().ok())),
            26 => drop(of(&self.frames, bytes).map(|it| it.read(bytes.u64(), bytes.u32()))),
            27 => drop(event(&bytes.text(), bytes.f64()).send()),
            28 => drop(event("e", 0.5).with(&bytes.text(), bytes.f64()).with(&bytes.text(), &*bytes.text()).send()),
            29 => {
                let many =
                    (0..bytes.u8()).fold(event("many", 1.0), |event, key| event.with(&key.to_string(), i64::MIN));
                drop(many.send());
            }
            30 => drop(start(&bytes.text()).with("k", bytes.u8() > 0).send()),
            31 => drop(stop(&bytes.text())),
            32 => [error, warn, trace][usize::from(bytes.u8() % 3)](&bytes.text()),
            33 => println!("{}", bytes.text()),
            34 => eprint!("{}", bytes.text()),
            35 => drop(Model::open(&bytes.text())),
            36 => drop(Tensor::from_values(&[bytes.u32(), bytes.u32()], &vec![0.5; usize::from(bytes.u16())])),
            37 => drop(of(&self.frames, bytes).map(|it| Tensor::from_frame(it, bytes.preprocess()))),
            38 => drop(of(&self.topics, bytes).map(|it| it.column(&it.field(bytes.path())?, u32::MAX))),
            39 => forget(&mut self.topics, bytes),
            40 => forget(&mut self.fields, bytes),
            41 => forget(&mut self.samples, bytes),
            42 => forget(&mut self.frames, bytes),
            43 => *self = Self::default(),
            44 => drop(std::hint::black_box(vec![0_u8; bytes.u32() as usize % (8 << 20)])),
            45 => drop((std::fs::read("/"), std::time::SystemTime::now(), std::time::Instant::now())),
            46 if bytes.u8() == 0xba => panic!("{}", bytes.text()),
            47 if bytes.u8() == 0xba => std::process::exit(i32::from(bytes.u8())),
            48 => drop(scratch::put(bytes.name(), &vec![1; bytes.u32() as usize % TEXT])),
            49 => drop(scratch::append(bytes.name(), &vec![2; usize::from(bytes.u16())])),
            50 => drop(scratch::put(&bytes.text(), b"")),
            51 => drop(scratch::get(bytes.name(), bytes.u64(), bytes.u32())),
            52 => drop(scratch::remove(bytes.name())),
            53 => drop((scratch::entries(), scratch::free(), scratch::get(bytes.name(), u64::from(bytes.u16()), 9))),
            _ => {}
        }
    }

    fn both(&self, bytes: &mut Bytes) -> Option<(&Topic, &Field)> {
        Some((of(&self.topics, bytes)?, of(&self.fields, bytes)?))
    }

    fn reading(&self, bytes: &mut Bytes) -> Option<(&Sample, &Field)> {
        Some((of(&self.samples, bytes)?, of(&self.fields, bytes)?))
    }
}

fn of<'a, T>(kept: &'a [T], bytes: &mut Bytes) -> Option<&'a T> {
    let number = usize::from(bytes.u8());
    kept.get(number.checked_rem(kept.len())?)
}

fn keep<T>(kept: &mut Vec<T>, more: Option<impl Iterator<Item = T>>) {
    kept.extend(more.into_iter().flatten());
}

fn forget<T>(kept: &mut Vec<T>, bytes: &mut Bytes) {
    let number = usize::from(bytes.u8());
    if let Some(number) = number.checked_rem(kept.len()) {
        kept.swap_remove(number);
    }
}

/// A program, taken apart from its begin.
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

    /// Some bytes as text; or one letter, so often that it is longer than anything may be.
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
        let paths = ["data", "data[3]", "width", "header.frame_id", "header.stamp.sec", "format", "step", "encoding"];
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

    fn preprocess(&mut self) -> Preprocess {
        let (width, height, fill) = (self.u32(), self.u32(), self.u8());
        let (mean, scale) = ((0.0, 0.0, 0.0), (f32::NAN, 1.0, 1.0));
        Preprocess { width, height, letterbox: fill > 99, fill, bgr: fill.is_multiple_of(2), mean, scale }
    }
}

gleaner_sdk::lambda!(Driver);
