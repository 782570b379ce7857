//! A lambda that takes more than its share, as its configuration says. The host has to notice.

use gleaner_sdk::{Config, Error, Field, Lambda, Result, Sample, Topic, event, input};

struct Greedy {
    behaviour: String,
    bytes: u32,
    camera: Topic,
    topics: Vec<Topic>,
    fields: Vec<Field>,
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
        Ok(Self { behaviour, bytes, camera: input("camera")?, topics: Vec::new(), fields: Vec::new() })
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
            "ok" => {}
            other => return Err(Error::new(format!("unknown behaviour `{other}`"))),
        }
        Ok(())
    }
}

gleaner_sdk::lambda!(Greedy);
