//! Exceeds its limits as configured. The host must detect it.

use gleaner_sdk::{Config, Error, Field, Frame, Lambda, Result, Sample, Topic, event, input, log};

pub struct Greedy {
    behaviour: String,
    bytes: u32,
    camera: Topic,
    topics: Vec<Topic>,
    fields: Vec<Field>,
    frames: Vec<Frame>,
}

impl Lambda for Greedy {
    fn init(config: &Config) -> Result<Self> {
        let behaviour = config.text("behaviour")?.to_owned();
        if behaviour == "endless_init" {
            loop {
                std::hint::black_box(&behaviour);
            }
        }
        let bytes = config.integer("bytes")? as u32;
        Ok(Self {
            behaviour,
            bytes,
            camera: input("camera")?,
            topics: Vec::new(),
            fields: Vec::new(),
            frames: Vec::new(),
        })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        match self.behaviour.as_str() {
            "topics" => loop {
                self.topics.push(input("camera")?);
            },
            "fields" => loop {
                self.fields.push(self.camera.field("height")?);
            },
            "read_cdr" => drop(sample.cdr(0, self.bytes)),
            "read_frame" => drop(sample.as_frame()?.read(0, self.bytes)),
            "mean_luma" => drop(sample.as_frame()?.mean_luma(None)?),
            "long_label" => event(&"x".repeat(self.bytes as usize), 0.0).send()?,
            "frames" => loop {
                self.frames.push(sample.as_frame()?);
            },
            "resized" => loop {
                self.frames.push(sample.as_frame()?.resize(8, 8)?);
            },
            "huge" => drop(sample.as_frame()?.resize(16_384, 16_384)?),
            "log" => (0..1000).for_each(|_| log::info(&"x".repeat(self.bytes as usize))),
            "events" => (0..self.bytes).try_for_each(|_| event("x", 1.0).send())?,
            "panic" => panic!("no, not today"),
            "endless" => loop {
                std::hint::black_box(self.bytes);
            },
            "memory" => loop {
                std::mem::forget(std::hint::black_box(Vec::<u8>::with_capacity(1 << 20)));
            },
            "ok" => {}
            other => return Err(Error::new(format!("unknown behaviour `{other}`"))),
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(Greedy);
