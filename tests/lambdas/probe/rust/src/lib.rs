//! Calls every function of the interface and reports the results. Its twin must get the same.

use gleaner_sdk::data::{Roi, Value, encoding_name};
use gleaner_sdk::inference::{ElementType, Model, Placement, Preprocess, Tensor, element_name};
use gleaner_sdk::trigger::AttributeValue;
use gleaner_sdk::{
    Config, Error, Field, Lambda, Result, Sample, Topic, event, input, inputs, log, now_ns, start,
    stop,
};

pub struct Probe {
    every: u64,
    camera: Topic,
    imu: Topic,
    forward: Field,
    covariance: Field,
    frame_id: Field,
    stamp: Field,
    data: Field,
}

impl Lambda for Probe {
    fn init(config: &Config) -> Result<Self> {
        let right = config.real("number")? == 1.5 && config.integer("count")? == 3;
        if !(right
            && config.boolean("yes")?
            && config.text("word")? == "probe"
            && inputs() == ["camera", "imu"])
        {
            return Err(Error::new(format!("unexpected {config:?}")));
        }
        let (camera, imu) = (input("camera")?, input("imu")?);
        Ok(Self {
            every: config.integer("every")?.unsigned_abs().max(1),
            forward: imu.field("linear_acceleration.x")?,
            covariance: imu.field("orientation_covariance")?,
            frame_id: imu.field("header.frame_id")?,
            stamp: imu.field("header.stamp.nanosec")?,
            data: camera.field("data")?,
            camera,
            imu,
        })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        // Hashing is slow in Python, so only some images are used.
        if !sample.identity().seq.is_multiple_of(self.every) {
            return Ok(());
        }
        self.topics()?;
        self.samples(&sample)?;
        self.frames(&sample)?;
        self.tensors(&sample)?;
        self.refusals(&sample)?;
        log::info(&format!("{} {}", self.forward.path(), now_ns()));
        start("recording").with("why", "probing").send()?;
        stop("recording")
    }
}

impl Probe {
    fn topics(&self) -> Result<()> {
        let counts = self.imu.counts();
        let newest = self.imu.newest().ok_or(Error::new("no sample"))?;
        let since = newest.stamps().at_ns - 50_000_000;
        let (last, later) =
            (self.imu.column(&self.forward, 5)?, self.imu.column_since(&self.forward, since)?);
        event("topic", newest.number(&self.forward)?)
            .with(
                "names",
                [self.imu.name(), self.imu.ros_topic(), self.imu.type_name()].join(" ").as_str(),
            )
            .with("received", counts.received as i64)
            .with("overwritten", counts.overwritten as i64)
            .with("refused", (counts.no_slot + counts.too_big + counts.skipped) as i64)
            .with("lost", counts.lost.is_some())
            .with("last", last.values[0])
            .with("last_at", last.at_ns[0])
            .with("since", later.values.len() as i64)
            .with(
                "samples",
                self.imu.last(7).map(|sample| sample.identity().seq as i64).sum::<i64>(),
            )
            .with("samples_since", self.imu.since(since).len() as i64)
            .send()
    }

    fn samples(&self, sample: &Sample) -> Result<()> {
        let (identity, stamps) = (sample.identity(), sample.stamps());
        let imu = self.imu.newest().ok_or(Error::new("no sample"))?;
        let Value::Numbers(covariance) = imu.get(&self.covariance)? else {
            return Err(Error::new("no numbers"));
        };
        let Value::Text(frame_id) = imu.get(&self.frame_id)? else {
            return Err(Error::new("no text"));
        };
        let Value::Unsigned(nanosec) = imu.get(&self.stamp)? else {
            return Err(Error::new("no number"));
        };
        let Value::Bytes(data) = sample.get(&self.data)? else {
            return Err(Error::new("no bytes"));
        };
        event("sample", sample.size() as f64)
            .with("topic", identity.topic.as_str())
            .with(
                "writer",
                format!("{:016x}{:016x}", identity.writer.high, identity.writer.low).as_str(),
            )
            .with("seq", identity.seq as i64)
            .with("at", stamps.at_ns)
            .with("published", stamps.publish_ns)
            .with("header", stamps.header_ns.unwrap_or(-1))
            .with("big_endian", sample.big_endian())
            .with("cdr", fnv1a(&sample.cdr(10, 100)))
            .with("end", sample.cdr(sample.size() - 1, 100).len() as i64)
            .with("covariance", covariance[0])
            .with("frame_id", frame_id.as_str())
            .with("nanosec", nanosec as i64)
            .with("data", fnv1a(&data))
            .send()
    }

    fn frames(&self, sample: &Sample) -> Result<()> {
        let frame = sample.as_frame()?;
        let info = frame.info();
        let corner = Some(Roi { x: 10, y: 20, width: 33, height: 44 });
        let histogram =
            frame.histogram(corner)?.into_iter().flat_map(u32::to_le_bytes).collect::<Vec<_>>();
        let (small, gray) = (frame.resize(60, 40)?, frame.to_gray()?);
        let mut pixels = vec![0; gray.info().size as usize];
        gray.copy_to(&mut pixels)?;
        event("frame", frame.mean_luma(None)?)
            .with("width", i64::from(info.width))
            .with("height", i64::from(info.height))
            .with("step", i64::from(info.step))
            .with("size", info.size as i64)
            .with("encoding", encoding_name(info.encoding))
            .with("big_endian", info.big_endian)
            .with("seq", frame.identity().seq as i64)
            .with("at", frame.stamps().at_ns)
            .with("corner", frame.mean_luma(corner)?)
            .with("histogram", fnv1a(&histogram))
            .with("read", fnv1a(&frame.read(1000, 5000)))
            .with("small", fnv1a(&small.read(0, u32::MAX)))
            .with("gray", fnv1a(&pixels))
            .send()
    }

    fn tensors(&self, sample: &Sample) -> Result<()> {
        let tensor = Tensor::create(ElementType::Int16, &[2, 3])?;
        tensor.write(3, &[1, 2, 3, 4, 5])?;
        let values = Tensor::from_values(&[3, 1], &[0.5_f32, -1.0, 2.0])?;
        let how = Preprocess {
            placement: Placement::Corner,
            bgr: true,
            mean: (0.5, 0.25, 0.0),
            ..Preprocess::new(32, 24)
        };
        // A fake host does not convert frames.
        let pixels = Tensor::from_frame(&sample.as_frame()?, how);
        event("tensor", values.values::<f32>()?.iter().copied().map(f64::from).sum())
            .with("element", element_name(tensor.element()))
            .with("shape", format!("{:?}", tensor.shape()).as_str())
            .with("size", tensor.size() as i64)
            .with("read", fnv1a(&tensor.read(2, 9)))
            .with("end", tensor.read(11, 9).len() as i64)
            .with("values", fnv1a(&values.read(0, u32::MAX)))
            .with("pixels", pixels.map_or(-1, |pixels| fnv1a(&pixels.read(0, u32::MAX))))
            .send()
    }

    fn refusals(&self, sample: &Sample) -> Result<()> {
        let frame = sample.as_frame()?;
        let tensor = Tensor::create(ElementType::Uint8, &[4])?;
        event("refusals", 0.0)
            .with("input", kind(input("nothing")))
            .with("field", kind(self.imu.field("nothing")))
            .with("other", kind(self.camera.column(&self.forward, 1)))
            .with("text", kind(self.imu.column(&self.frame_id, 1)))
            .with("image", kind(self.imu.newest().ok_or(Error::new("no sample"))?.as_frame()))
            .with(
                "outside",
                kind(frame.mean_luma(Some(Roi { x: 9999, y: 0, width: 1, height: 1 }))),
            )
            .with("size", kind(frame.resize(0, 1)))
            .with("room", kind(frame.resize(16_384, 16_384)))
            .with("label", kind(event("", 0.0).send()))
            .with("score", kind(event("x", f64::INFINITY).send()))
            .with("model", kind(Model::open("nothing")))
            .with("empty", kind(Tensor::create(ElementType::Boolean, &[2, 0])))
            .with("write", kind(tensor.write(1, &[0; 4])))
            .with("tensor", kind(Tensor::from_frame(&frame, Preprocess::new(0, 8))))
            .send()
    }
}

/// The kind of the refusal; `none` for a result.
fn kind<T>(answer: Result<T>) -> AttributeValue {
    let kind = answer.err().and_then(|error| error.kind());
    kind.map_or("none".into(), |kind| kind.to_string().as_str().into())
}

fn fnv1a(bytes: &[u8]) -> i64 {
    i64::from(
        bytes.iter().fold(0x811c_9dc5, |hash: u32, byte| {
            (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193)
        }),
    )
}

gleaner_sdk::lambda!(Probe);
