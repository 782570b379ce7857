//! A frame's way through a model as `detect` of a lambda takes it, without the lambda: the frame is
//! prepared, sent to `gleaner-inference` through shared memory, and its outputs are decoded.

use std::fs::File;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt;
use std::time::{Duration, Instant};

use gleaner_pixels::vision::{
    Detection, DetectorLayout, OutputView, Placed, Preparer, Preprocess, Wanted, detect,
};
use gleaner_protocol::inference::{
    ModelCall, ModelClient, ModelResult, ModelWait, TensorInfo, TensorPlace,
};
use gleaner_rules::pixels::{Encoding, View};
use rustix::time::{ClockId, clock_gettime};
use zerocopy::IntoBytes;

use super::frames::{HEIGHT, WIDTH};
use super::{MAX_COUNT, MAX_IOU, MIN_SCORE};

/// A caller of one model.
pub(super) struct LambdaPath {
    client: ModelClient,
    model: &'static str,
    layout: DetectorLayout,
    input: TensorInfo,
    how: Preprocess,
    preparer: Preparer,
    prepared: Vec<u8>,
    values: Vec<f32>,
    inputs: File,
    outputs: Option<File>,
    /// Backend, version, provider and threads.
    pub(super) runtime: String,
}

pub(super) struct PathResult {
    /// From the frame to its boxes.
    pub(super) total: Duration,
    /// The conversion of the frame in it.
    pub(super) prepare: Duration,
    /// The run of the model in it.
    pub(super) session: Duration,
    pub(super) detections: Vec<Detection>,
}

impl LambdaPath {
    /// Opens the model; returns the reason if it cannot be loaded.
    pub(super) fn open(
        mut client: ModelClient,
        model: &'static str,
        layout: DetectorLayout,
    ) -> Result<Self, String> {
        let (opened, _) = call(&mut client, ModelCall::Open { model: model.to_owned() }, None)?;
        let ModelResult::Opened { inputs, runtime, .. } = opened else {
            return Err("another reply".to_owned());
        };
        let input = inputs.into_iter().next().ok_or("it has no input")?;
        let how = layout.preprocess(&input.shape).map_err(|error| error.to_string())?;
        let bytes = how.size().map_err(|error| error.to_string())? as u64;
        let (_, region) = call(&mut client, ModelCall::Reserve { bytes }, None)?;
        let inputs = File::from(region.ok_or("no region")?);
        let (preparer, prepared, values) = (Preparer::new(), Vec::new(), Vec::new());
        Ok(Self {
            client,
            model,
            layout,
            input,
            how,
            preparer,
            prepared,
            values,
            inputs,
            outputs: None,
            runtime,
        })
    }

    /// Finds objects in a frame.
    pub(super) fn detect(&mut self, frame: &[u8]) -> PathResult {
        let started = Instant::now();
        let placed = self.prepare(frame);
        let prepare = started.elapsed();
        let (place, session) = self.run(None);
        let view = OutputView { shape: &place.shape, values: &self.values };
        let wanted =
            Wanted { classes: None, min_score: MIN_SCORE, max_iou: MAX_IOU, max_count: MAX_COUNT };
        let detections = detect(self.layout, &[view], &placed, &wanted).expect("a detector");
        PathResult { total: started.elapsed(), prepare, session, detections }
    }

    /// Prepares a frame as the next input.
    pub(super) fn prepare(&mut self, frame: &[u8]) -> Placed {
        let view = View::new(WIDTH, HEIGHT, 3 * WIDTH, Encoding::Bgr8, false, frame);
        let view = view.expect("the frame has this size");
        self.preparer.prepare(&view, &self.how, &mut self.prepared).expect("it can be prepared")
    }

    /// Changes a few values of the prepared input, so that no earlier run had an equal one.
    pub(super) fn mark(&mut self, number: u32) {
        for bit in 0..32 {
            let value = f32::from(u8::from(number >> bit & 1 == 1));
            self.prepared[4 * bit..4 * bit + 4].copy_from_slice(&value.to_le_bytes());
        }
    }

    /// Values of the output of the last run.
    pub(super) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Runs the model on the prepared input; returns the place of its output and the run time of
    /// the model.
    pub(super) fn run(&mut self, deadline: Option<Duration>) -> (TensorPlace, Duration) {
        self.inputs.write_all_at(&self.prepared, 0).expect("the region is as large as the input");
        let TensorInfo { name, element, .. } = self.input.clone();
        let place = TensorPlace { name, element, shape: self.how.shape().to_vec(), offset: 0 };
        let run = ModelCall::Run { model: self.model.to_owned(), inputs: vec![place] };
        let (result, region) = call(&mut self.client, run, deadline).expect("the model runs");
        let ModelResult::Ran { outputs, run_ns } = result else { panic!("another reply") };
        if let Some(region) = region {
            self.outputs = Some(File::from(region));
        }
        let place = outputs.into_iter().next().expect("an output");
        let bytes = place.bytes().expect("its size is known");
        self.values.resize(bytes as usize / size_of::<f32>(), 0.0);
        let region = self.outputs.as_ref().expect("a region of outputs");
        region
            .read_exact_at(self.values.as_mut_bytes(), place.offset)
            .expect("the outputs are there");
        (place, Duration::from_nanos(run_ns))
    }

    /// Memory of the caller in MiB: the frame, the prepared input, the output, and both regions.
    pub(super) fn buffers_mib(&self) -> f64 {
        let input = self.prepared.len() as f64;
        let output = size_of_val(self.values()) as f64;
        (f64::from(3 * WIDTH * HEIGHT) + 2.0 * input + 2.0 * output) / f64::from(1 << 20)
    }
}

/// Makes a call, and waits for its reply.
fn call(
    client: &mut ModelClient,
    call: ModelCall,
    deadline: Option<Duration>,
) -> Result<(ModelResult, Option<OwnedFd>), String> {
    let deadline_ns = deadline.map(|deadline| monotonic_ns() + deadline.as_nanos() as u64);
    match client.call(call, deadline_ns, None) {
        Ok(ModelWait::Reply(reply, region)) => {
            reply.result.map(|result| (result, region)).map_err(|fault| fault.message)
        }
        Ok(ModelWait::TimedOut) => Err("no reply".to_owned()),
        Err(error) => Err(error.to_string()),
    }
}

fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
