//! A thread that runs models, one after another.
//!
//! It copies inputs out of shared memory before anything reads them, and keeps inputs and outputs
//! of the last run of each model: the next request with the same bytes is answered with these.
//! The next inputs take the place of the last: for 5 MB, fresh memory takes longer than the copy.

use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{Element, ModelFault, ModelFaultKind, TensorInfo, TensorPlace};

use crate::backend::{LoadedGraph, StopSignal, TensorValue};
use crate::loader::caught;
use crate::memory;
use crate::places::{PlacedInput, place_outputs};
use crate::region::TensorRegion;
use crate::running::{ModelWork, WorkNote};
use crate::sessions::SessionId;

/// Time after its deadline for which a run may go on that cannot be interrupted. Other models run
/// beside it.
const GRACE: Duration = Duration::from_secs(10);

/// A loaded model. One thread uses it at a time.
pub(crate) type SharedModel = Arc<Mutex<WorkerModel>>;

pub(crate) struct WorkerModel {
    pub(crate) graph: Box<dyn LoadedGraph>,
    pub(crate) sha256: String,
    pub(crate) path: String,
    /// Memory that it took when it was loaded, in bytes.
    pub(crate) held: u64,
    pub(crate) outputs: Vec<TensorInfo>,
    pub(crate) last: LastRun,
}

#[derive(Default)]
pub(crate) struct LastRun {
    inputs: Vec<TensorValue>,
    result: Option<LastResult>,
}

struct LastResult {
    outputs: Vec<TensorValue>,
    run_ns: u64,
}

pub(crate) struct RunJob {
    pub(crate) job: u64,
    pub(crate) session: SessionId,
    pub(crate) model: SharedModel,
    /// Identity and name of the lambda.
    pub(crate) lambda: [String; 2],
    pub(crate) inputs: Vec<PlacedInput>,
    /// Region of the inputs; `None` if there are none.
    pub(crate) input_region: Option<Arc<TensorRegion>>,
    /// Region of the outputs of earlier runs.
    pub(crate) output_region: Option<Arc<TensorRegion>>,
    /// Largest size of the outputs.
    pub(crate) memory: u64,
    /// Time until the deadline, if there is one.
    pub(crate) left: Option<Duration>,
    pub(crate) stop: Arc<StopSignal>,
}

pub(crate) struct RunDone {
    pub(crate) job: u64,
    pub(crate) session: SessionId,
    pub(crate) result: Result<RunOutputs, ModelFault>,
    /// Time of the run, in ns, if the model ran.
    pub(crate) ran_ns: Option<u64>,
}

pub(crate) struct RunOutputs {
    pub(crate) places: Vec<TensorPlace>,
    pub(crate) region: Arc<TensorRegion>,
    /// Run time of the model in ns; that of the first run if the result is shared.
    pub(crate) run_ns: u64,
}

pub(crate) struct ModelWorker {
    note: WorkNote,
    run_max: Duration,
}

impl ModelWorker {
    pub(crate) fn new(note: WorkNote, run_max: Duration) -> Self {
        Self { note, run_max }
    }

    pub(crate) fn run(&self, job: &RunJob) -> RunDone {
        let done = |result, ran_ns| RunDone { job: job.job, session: job.session, result, ran_ns };
        if job.stop.is_stopped() {
            return done(Err(failed("nothing waits for the result")), None);
        }
        // A panic leaves at worst results that are taken before they are read.
        let mut model = job.model.lock().unwrap_or_else(PoisonError::into_inner);
        let [id, name] = &job.lambda;
        let limit = job.left.map_or(self.run_max, |left| self.run_max.min(left + GRACE));
        self.note.begin(ModelWork {
            note: format!("{} {id}", model.sha256),
            path: model.path.clone(),
            held: model.held,
            lambdas: vec![name.clone()],
            until: Instant::now() + limit,
            limit,
            stop: Arc::clone(&job.stop),
        });
        let (result, ran_ns) = model.run(job);
        self.note.end();
        done(result, ran_ns)
    }
}

impl WorkerModel {
    fn run(&mut self, job: &RunJob) -> (Result<RunOutputs, ModelFault>, Option<u64>) {
        let shared = match self.last.read_inputs(job) {
            Ok(shared) => shared,
            Err(error) => {
                return (Err(failed(&format!("the inputs cannot be read: {error}"))), None);
            }
        };
        let ran_ns = if shared {
            None
        } else {
            let start = Instant::now();
            let ran = caught(|| self.graph.run(&self.last.inputs, &job.stop));
            let run_ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
            let ran = ran.and_then(|ran| ran.map_err(|error| error.to_string()));
            match ran {
                Ok(outputs) => self.last.result = Some(LastResult { outputs, run_ns }),
                Err(_) if job.stop.is_stopped() => {
                    let message = format!("model `{}` was interrupted", self.path);
                    let fault = ModelFault::new(ModelFaultKind::TooSlow, message);
                    return (Err(fault), Some(run_ns));
                }
                Err(error) => {
                    let error = format!("model `{}`: its run failed: {error}", self.path);
                    return (Err(failed(&error)), Some(run_ns));
                }
            }
            Some(run_ns)
        };
        let last = self.last.result.as_ref().expect("it is the same, or has just run");
        if job.stop.is_stopped() {
            // The lambda may use the region for its next request.
            return (Err(failed("nothing waits for the result")), ran_ns);
        }
        let written = last.write(&self.outputs, job);
        if written.is_err() || memory::is_short(2, 0) {
            // Others may need it before the next run.
            self.last = LastRun::default();
        }
        (written, ran_ns)
    }
}

impl LastResult {
    fn write(&self, infos: &[TensorInfo], job: &RunJob) -> Result<RunOutputs, ModelFault> {
        let tensors = infos.iter().zip(&self.outputs);
        let named = tensors.map(|(info, it)| (info.name.as_str(), it.element, it.shape.as_slice()));
        let (places, bytes) = place_outputs(named).map_err(|error| failed(&error.to_string()))?;
        let no_memory = |error: io::Error| failed(&format!("the outputs cannot be sent: {error}"));
        if bytes > job.memory {
            let allowed = job.memory;
            return Err(failed(&format!(
                "the outputs have {bytes} bytes, above the {allowed} of `memory` in [limits]"
            )));
        }
        let fitting = job.output_region.clone().filter(|region| region.bytes() >= bytes);
        let region = match fitting {
            Some(region) => region,
            None => Arc::new(TensorRegion::create("gleaner-outputs", bytes).map_err(no_memory)?),
        };
        for (place, output) in places.iter().zip(&self.outputs) {
            region.write(place.offset, &output.bytes).map_err(no_memory)?;
        }
        Ok(RunOutputs { places, region, run_ns: self.run_ns })
    }
}

fn failed(message: &str) -> ModelFault {
    ModelFault::new(ModelFaultKind::Failed, message)
}

impl LastRun {
    /// Copies the inputs of `job` out of the region; returns whether there is a result for them.
    fn read_inputs(&mut self, job: &RunJob) -> io::Result<bool> {
        let result = self.result.take();
        let mut is_same = self.inputs.len() == job.inputs.len();
        self.inputs.truncate(job.inputs.len());
        for (index, input) in job.inputs.iter().enumerate() {
            let region = job.input_region.as_ref().ok_or(io::ErrorKind::NotFound)?;
            let (element, shape) = (input.element, &input.shape);
            match self.inputs.get_mut(index) {
                Some(value) if value.element == element && value.shape == *shape => {}
                Some(value) => {
                    is_same = false;
                    (value.element, value.shape) = (element, shape.clone());
                }
                None => {
                    let (shape, bytes) = (shape.clone(), Vec::new());
                    self.inputs.push(TensorValue { element, shape, bytes });
                }
            }
            let bytes = &mut self.inputs[index].bytes;
            let length = usize::try_from(input.bytes).map_err(io::Error::other)?;
            if bytes.len() != length {
                // Not a larger one for a smaller input: it would be kept.
                (*bytes, is_same) = (vec![0; length], false);
            }
            is_same &= read_changes(region, input, bytes)?;
        }
        self.result = result.filter(|_| is_same);
        Ok(self.result.is_some())
    }
}

/// Copies an input over `known`; returns whether it has the same bytes. Those of booleans become 0
/// or 1.
fn read_changes(region: &TensorRegion, input: &PlacedInput, known: &mut [u8]) -> io::Result<bool> {
    /// Fits into the first cache of a CPU.
    const PIECE: usize = 16 << 10;
    let mut buffer = [0; PIECE];
    let (mut is_same, mut offset) = (true, input.offset);
    for known in known.chunks_mut(PIECE) {
        let piece = &mut buffer[..known.len()];
        region.read(offset, piece)?;
        offset += piece.len() as u64;
        if input.element == Element::Boolean {
            piece.iter_mut().for_each(|byte| *byte = u8::from(*byte != 0));
        }
        if piece != known {
            known.copy_from_slice(piece);
            is_same = false;
        }
    }
    Ok(is_same)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::BackendError;
    use crate::sessions::{SessionKey, SessionTable};

    /// Returns its input, and panics for a first byte of 255.
    struct Echo;

    impl LoadedGraph for Echo {
        fn run(
            &mut self,
            inputs: &[TensorValue],
            _stop: &StopSignal,
        ) -> Result<Vec<TensorValue>, BackendError> {
            assert_ne!(inputs[0].bytes[0], 255, "as requested");
            Ok(inputs.to_vec())
        }
    }

    struct Bench {
        worker: ModelWorker,
        session: SessionId,
        model: SharedModel,
        region: Arc<TensorRegion>,
        outputs: Option<Arc<TensorRegion>>,
    }

    fn bench(element: Element) -> Bench {
        let note = WorkNote::new(1, None);
        let worker = ModelWorker::new(note, Duration::from_secs(60));
        let key = SessionKey { sha256: "0".repeat(64), providers: Vec::new(), threads: 1 };
        let session = SessionTable::default().add(key.clone(), String::new());
        let info = TensorInfo { name: "y".to_owned(), element, shape: vec![None] };
        let model = WorkerModel {
            graph: Box::new(Echo),
            sha256: key.sha256,
            path: "m.onnx".to_owned(),
            held: 0,
            outputs: vec![info],
            last: LastRun::default(),
        };
        let model = Arc::new(Mutex::new(model));
        let region = Arc::new(TensorRegion::create("test", 8192).unwrap());
        Bench { worker, session, model, region, outputs: None }
    }

    impl Bench {
        fn run(&mut self, element: Element, bytes: &[u8]) -> RunDone {
            self.region.write(0, bytes).unwrap();
            let shape = vec![bytes.len() as u32];
            let input = PlacedInput { element, shape, offset: 0, bytes: bytes.len() as u64 };
            let job = RunJob {
                job: 1,
                session: self.session,
                model: Arc::clone(&self.model),
                lambda: ["test".to_owned(), "test".to_owned()],
                inputs: vec![input],
                input_region: Some(Arc::clone(&self.region)),
                output_region: self.outputs.clone(),
                memory: 6000,
                left: None,
                stop: Arc::default(),
            };
            self.worker.run(&job)
        }
    }

    #[test]
    fn equal_inputs_share_a_run_and_a_region_is_replaced_when_it_is_too_small() {
        let mut bench = bench(Element::Uint8);
        let first = bench.run(Element::Uint8, b"abc");
        let outputs = first.result.unwrap();
        assert!(first.ran_ns.is_some());
        bench.outputs = Some(Arc::clone(&outputs.region));
        let second = bench.run(Element::Uint8, b"abc");
        assert_eq!(second.ran_ns, None, "it is shared");
        let shared = second.result.unwrap();
        assert_eq!(shared.run_ns, outputs.run_ns);
        assert_eq!(shared.region.id, outputs.region.id);
        let third = bench.run(Element::Uint8, &[7; 5000]).result.unwrap();
        assert_ne!(third.region.id, outputs.region.id, "the first one has 4096 bytes");
        let mut found = [0; 5000];
        third.region.read(0, &mut found).unwrap();
        assert_eq!(found, [7; 5000]);
        let fault = bench.run(Element::Uint8, &[7; 6001]).result.err().unwrap();
        assert!(fault.message.contains("6001 bytes, above the 6000 of `memory`"), "{fault:?}");
        // The same bytes in another shape are another input.
        assert!(bench.run(Element::Uint8, &[7; 100]).ran_ns.is_some());
    }

    #[test]
    fn bytes_of_booleans_become_0_or_1() {
        let mut bench = bench(Element::Boolean);
        let done = bench.run(Element::Boolean, &[0, 1, 7, 255]);
        let region = done.result.unwrap().region;
        let mut found = [9; 4];
        region.read(0, &mut found).unwrap();
        assert_eq!(found, [0, 1, 1, 1]);
    }

    #[test]
    fn a_panic_fails_one_run_only() {
        let mut bench = bench(Element::Uint8);
        // The second time, nothing is left of the first to be shared.
        for _ in 0..2 {
            let fault = bench.run(Element::Uint8, &[255]).result.err().unwrap();
            assert_eq!(fault.kind, ModelFaultKind::Failed);
            assert!(fault.message.contains("the library panicked"), "{}", fault.message);
        }
        assert!(bench.run(Element::Uint8, &[1]).result.is_ok());
    }
}
