//! The models of a lambda: its connection to `gleaner-inference`, which runs them, and the time
//! that they take.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use gleaner_base::chain;
use gleaner_pixels::vision::{DetectorLayout, ExportNote, OutputView, Preparer};
use gleaner_protocol::inference::{
    Element, MAX_TENSOR_BYTES, ModelCall, ModelClient, ModelFault, ModelReply, ModelResult,
    ModelWait, TENSOR_ALIGNMENT, TensorInfo, TensorPlace,
};
use gleaner_protocol::link::LinkError;
use gleaner_protocol::process_stats::monotonic_ns;
use zerocopy::IntoBytes;

use super::call::Due;
use super::inference::InferenceError;
use time::ModelTime;

mod time;

/// Time after the deadline for which a reply is awaited.
const REPLY_TIMEOUT: Duration = Duration::from_millis(20);

/// Longest wait for the loads of other lambdas. One may take minutes, on a GPU.
const OTHER_LOADS: Duration = Duration::from_secs(600);

/// Most runtimes of all models that are stated, and most characters of one.
const RUNTIMES: usize = 1024;
const RUNTIME_MAX: usize = 256;

/// A `[[model]]` of the manifest.
pub struct ModelEntry {
    pub name: String,
    pub layout: Option<DetectorLayout>,
    pub labels: Vec<String>,
}

/// The models of a lambda. Clones share the connection; one call is made at a time.
#[derive(Clone, Default)]
pub struct Models {
    state: Arc<Mutex<ModelsState>>,
    time: Arc<ModelTime>,
}

#[derive(Default)]
struct ModelsState {
    entries: Vec<Arc<ModelEntry>>,
    connection: Option<Connection>,
    preparer: Preparer,
    /// The prepared frame, whose memory is used again.
    prepared: Vec<u8>,
    /// The outputs for it, whose memory is used again.
    floats: Vec<Vec<f32>>,
}

/// The connection to `gleaner-inference`.
struct Connection {
    client: ModelClient,
    /// Largest size of inputs, and of outputs.
    memory: u64,
    /// The region for inputs, and its size.
    inputs: Option<(File, u64)>,
    outputs: Option<File>,
    opened: Vec<(String, Arc<OpenedModel>)>,
    /// Name and runtime of all that were opened, each once, also by processes before this one.
    runtimes: Vec<(String, String)>,
    /// The reason why the process has ended, until the next one has started.
    ended: Option<String>,
}

#[derive(Debug)]
pub struct OpenedModel {
    pub inputs: Vec<TensorInfo>,
    pub outputs: Vec<TensorInfo>,
    /// Backend, version, provider and threads.
    pub runtime: String,
    pub note: ExportNote,
}

/// An input or output in the memory of this process.
pub(super) struct TensorBytes<T> {
    /// Name, type and shape; the offset is 0.
    pub(super) place: TensorPlace,
    pub(super) bytes: T,
}

/// Outputs of a run, in the order of the model.
pub(super) type Outputs = Vec<TensorBytes<Vec<u8>>>;

impl Models {
    /// The models `entries`, over `socket` if the starter passed one. `memory` is that of
    /// `[limits]`.
    pub fn new(entries: Vec<ModelEntry>, socket: Option<OwnedFd>, memory: u64) -> Self {
        let connection = socket.map(|socket| Connection {
            client: ModelClient::new(socket),
            memory,
            inputs: None,
            outputs: None,
            opened: Vec::new(),
            runtimes: Vec::new(),
            ended: None,
        });
        let entries = entries.into_iter().map(Arc::new).collect();
        let state = ModelsState { entries, connection, ..Default::default() };
        Self { state: Arc::new(Mutex::new(state)), time: Arc::default() }
    }

    /// Opens all models, so that `init` finds them loaded. Errors are logged; the lambda opens them
    /// again. A load may take `timeout`, which begins when those of other lambdas are over.
    pub fn open_all(&self, timeout: Duration) {
        let latest = Instant::now() + OTHER_LOADS;
        let mut state = self.lock();
        for entry in state.entries.clone() {
            if let Err(error) = state.open_in_turn(&entry.name, timeout, latest) {
                tracing::warn!(model = entry.name, error = chain(&error), "cannot open the model");
            }
        }
    }

    /// Backend, version, provider and threads of each model, by its name; `none` for one that was
    /// not loaded.
    pub fn runtimes(&self) -> Vec<String> {
        let state = self.lock();
        let runtime = |entry: &Arc<ModelEntry>| {
            let all = state.connection.iter().flat_map(|connection| &connection.runtimes);
            let ran = all.filter(|(name, _)| *name == entry.name).map(|(_, runtime)| &**runtime);
            let ran: Vec<&str> = ran.collect();
            let ran = if ran.is_empty() { "none".to_owned() } else { ran.join(", then ") };
            format!("model `{}`: {ran}", entry.name)
        };
        state.entries.iter().map(runtime).collect()
    }

    /// Returns the model of that name and its entry, loaded.
    pub(super) fn open(
        &self,
        name: &str,
        due: &Due,
    ) -> Result<(Arc<ModelEntry>, Arc<OpenedModel>), InferenceError> {
        let mut state = self.lock();
        let entry = state.entries.iter().find(|entry| entry.name == name).cloned();
        let entry = entry.ok_or_else(|| {
            let known: Vec<_> = state.entries.iter().map(|entry| &*entry.name).collect();
            InferenceError::no_such_model(name, &known)
        })?;
        Ok((entry, state.open(name, self.time.earliest(due).at())?))
    }

    pub(super) fn run(
        &self,
        name: &str,
        inputs: &[TensorBytes<&[u8]>],
        due: &Due,
    ) -> Result<Outputs, InferenceError> {
        let mut state = self.lock();
        let places = state.run(name, inputs, &self.time.earliest(due), &self.time)?;
        let read = |place: TensorPlace| {
            let mut bytes = vec![0; length(&place)?];
            state.read(&place, &mut bytes)?;
            Ok(TensorBytes { place, bytes })
        };
        places.into_iter().map(read).collect()
    }

    /// Runs a model on one input that `prepare` writes, and passes its outputs, all of `float32`,
    /// to `decode`. Memory for both is used again.
    pub(super) fn run_prepared<P, R>(
        &self,
        name: &str,
        place: TensorPlace,
        due: &Due,
        prepare: impl FnOnce(&mut Preparer, &mut Vec<u8>) -> Result<P, InferenceError>,
        decode: impl FnOnce(P, &[OutputView<'_>]) -> Result<R, InferenceError>,
    ) -> Result<R, InferenceError> {
        let mut state = self.lock();
        let mut bytes = std::mem::take(&mut state.prepared);
        let mut floats = std::mem::take(&mut state.floats);
        let result = prepare(&mut state.preparer, &mut bytes).and_then(|placed| {
            let input = TensorBytes { place, bytes: bytes.as_slice() };
            let places = state.run(name, &[input], &self.time.earliest(due), &self.time)?;
            floats.resize_with(places.len(), Vec::new);
            for (place, values) in places.iter().zip(&mut floats) {
                let TensorPlace { name: output, element, .. } = place;
                if *element != Element::Float32 {
                    return Err(InferenceError::WrongInput(format!(
                        "model `{name}`: output `{output}` is {element}, and `detect` needs float32"
                    )));
                }
                values.resize(length(place)? / size_of::<f32>(), 0.0);
                state.read(place, values.as_mut_bytes())?;
            }
            let views = places.iter().zip(&floats);
            let views = views.map(|(place, values)| OutputView { shape: &place.shape, values });
            decode(placed, &views.collect::<Vec<_>>())
        });
        (state.prepared, state.floats) = (bytes, floats);
        result
    }

    pub(super) fn prepare<P>(
        &self,
        prepare: impl FnOnce(&mut Preparer) -> Result<P, InferenceError>,
    ) -> Result<P, InferenceError> {
        prepare(&mut self.lock().preparer)
    }

    fn lock(&self) -> MutexGuard<'_, ModelsState> {
        // After a panic, at worst a region is requested again.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ModelsState {
    /// Opens a model within `timeout`; until `latest`, waits as long again while others are loaded.
    fn open_in_turn(
        &mut self,
        name: &str,
        timeout: Duration,
        latest: Instant,
    ) -> Result<Arc<OpenedModel>, InferenceError> {
        let mut began_late = false;
        loop {
            match self.open(name, Some(Instant::now() + timeout)) {
                Err(InferenceError::Queued(reason)) if Instant::now() < latest => {
                    tracing::warn!(reason, "waiting for model to load");
                    began_late = true;
                }
                // Its load began within this time, and gets its own.
                Err(InferenceError::TooSlow(_)) if began_late => began_late = false,
                result => return result,
            }
        }
    }

    fn open(
        &mut self,
        name: &str,
        until: Option<Instant>,
    ) -> Result<Arc<OpenedModel>, InferenceError> {
        self.connection.as_mut().ok_or_else(not_connected)?.open(name, until)
    }

    fn run(
        &mut self,
        name: &str,
        inputs: &[TensorBytes<&[u8]>],
        due: &Due,
        time: &ModelTime,
    ) -> Result<Vec<TensorPlace>, InferenceError> {
        let started = Instant::now();
        let left = time.left();
        let too_slow = || InferenceError::too_slow(name, time.allowed().unwrap_or_default());
        if left.is_some_and(|left| left.is_zero()) {
            return Err(too_slow());
        }
        let of_models = left.map(|left| started + left);
        let until = [due.at(), of_models].into_iter().flatten().min();
        let connection = self.connection.as_mut().ok_or_else(not_connected)?;
        connection.check_process(until)?;
        let result = connection
            .open(name, until)
            .and_then(|_| connection.run(name, inputs, until))
            .map_err(|error| match error {
                // Before the deadline, the time of the models is over.
                InferenceError::OutOfTime if due.check().is_ok() => too_slow(),
                InferenceError::TooSlow(_) | InferenceError::Queued(_) if due.check().is_err() => {
                    InferenceError::OutOfTime
                }
                InferenceError::TooSlow(state) | InferenceError::Queued(state) => {
                    InferenceError::TooSlow(format!("{state}: {}", too_slow()))
                }
                error => error,
            });
        time.add(match &result {
            // An equal run of another lambda may have taken longer than this one waited.
            Ok((_, ran)) => (*ran).min(started.elapsed()),
            Err(_) => started.elapsed(),
        });
        result.map(|(outputs, _)| outputs)
    }

    /// Copies an output of the last run.
    fn read(&self, place: &TensorPlace, bytes: &mut [u8]) -> Result<(), InferenceError> {
        let connection = self.connection.as_ref().ok_or_else(not_connected)?;
        let region = connection.outputs.as_ref().ok_or_else(unexpected)?;
        region.read_exact_at(bytes, place.offset).map_err(region_failed)
    }
}

/// Returns the size of an output in bytes.
fn length(place: &TensorPlace) -> Result<usize, InferenceError> {
    let length = place.bytes().and_then(|length| usize::try_from(length).ok());
    length.ok_or_else(unexpected)
}

impl Connection {
    fn find(&self, name: &str) -> Option<Arc<OpenedModel>> {
        self.opened.iter().find(|(known, _)| known == name).map(|(_, opened)| Arc::clone(opened))
    }

    /// Notes what the starter has sent about the process.
    fn note_process(&mut self) -> Result<(), InferenceError> {
        while let Some(reply) = self.client.poll().map_err(failed)? {
            self.note(&reply);
        }
        Ok(())
    }

    /// Returns an error while the process is not running. Without a deadline, waits for the next.
    fn check_process(&mut self, until: Option<Instant>) -> Result<(), InferenceError> {
        self.note_process()?;
        if until.is_none() {
            self.wait_for_process(None)?;
        }
        match &self.ended {
            Some(reason) => {
                Err(InferenceError::Unavailable(format!("{reason}; it is being started again")))
            }
            None => Ok(()),
        }
    }

    fn wait_for_process(&mut self, until: Option<Instant>) -> Result<(), InferenceError> {
        self.note_process()?;
        while self.ended.is_some() {
            match self.client.wait_for_starter(until).map_err(failed)? {
                Some(reply) => self.note(&reply),
                None => return Err(InferenceError::OutOfTime),
            }
        }
        Ok(())
    }

    /// Notes the end or the start of the process. Its end may not have been sent before its start.
    fn note(&mut self, reply: &ModelReply) {
        (self.inputs, self.outputs) = (None, None);
        self.opened.clear();
        self.ended = reply.result.as_ref().err().map(|fault| fault.message.clone());
    }

    fn open(
        &mut self,
        name: &str,
        until: Option<Instant>,
    ) -> Result<Arc<OpenedModel>, InferenceError> {
        if let Some(opened) = self.find(name) {
            return Ok(opened);
        }
        // Another model may end the process meanwhile, which must not keep this one from loading.
        let result = loop {
            self.wait_for_process(until)?;
            match self.call(ModelCall::Open { model: name.to_owned() }, until) {
                Err(InferenceError::Unavailable(_)) if self.ended.is_some() => {}
                Err(InferenceError::Restarted) => {}
                result => break result?.0,
            }
        };
        let ModelResult::Opened { inputs, outputs, runtime, metadata } = result else {
            return Err(unexpected());
        };
        let note = ExportNote::of(metadata.iter().map(|(key, value)| (&**key, &**value)));
        let entry = (name.to_owned(), runtime.chars().take(RUNTIME_MAX).collect());
        if self.runtimes.len() < RUNTIMES && !self.runtimes.contains(&entry) {
            self.runtimes.push(entry);
        }
        let opened = Arc::new(OpenedModel { inputs, outputs, runtime, note });
        self.opened.push((name.to_owned(), Arc::clone(&opened)));
        Ok(opened)
    }

    fn run(
        &mut self,
        name: &str,
        inputs: &[TensorBytes<&[u8]>],
        until: Option<Instant>,
    ) -> Result<(Vec<TensorPlace>, Duration), InferenceError> {
        let mut places = Vec::new();
        let mut end = 0_u64;
        for input in inputs {
            places.push(TensorPlace { offset: end, ..input.place.clone() });
            end = end.saturating_add(input.bytes.len() as u64).next_multiple_of(TENSOR_ALIGNMENT);
        }
        if end > MAX_TENSOR_BYTES {
            let inputs = format!("the inputs of model `{name}` have {end} bytes");
            return Err(InferenceError::WrongInput(format!("{inputs}, above {MAX_TENSOR_BYTES}")));
        }
        if self.inputs.as_ref().is_none_or(|(_, bytes)| *bytes < end) {
            match self.call(ModelCall::Reserve { bytes: end.max(1) }, until)? {
                (ModelResult::Reserved, Some(region)) => {
                    self.inputs = Some((File::from(region), end));
                }
                _ => return Err(unexpected()),
            }
        }
        let Some((region, _)) = &self.inputs else { return Err(unexpected()) };
        for (input, place) in inputs.iter().zip(&places) {
            region.write_all_at(input.bytes, place.offset).map_err(region_failed)?;
        }
        let call = ModelCall::Run { model: name.to_owned(), inputs: places };
        let (result, region) = self.call(call, until)?;
        let ModelResult::Ran { outputs, run_ns } = result else { return Err(unexpected()) };
        let all = outputs.iter().map(TensorPlace::bytes).try_fold(0_u64, |all, bytes| {
            all.checked_add(bytes?).filter(|all| *all <= self.memory)
        });
        if all.is_none() {
            return Err(unexpected());
        }
        if let Some(region) = region {
            self.outputs = Some(File::from(region));
        }
        Ok((outputs, Duration::from_nanos(run_ns)))
    }

    fn call(
        &mut self,
        call: ModelCall,
        until: Option<Instant>,
    ) -> Result<(ModelResult, Option<OwnedFd>), InferenceError> {
        let deadline_ns = until.map(|until| {
            let left = until.saturating_duration_since(Instant::now());
            monotonic_ns().saturating_add(u64::try_from(left.as_nanos()).unwrap_or(u64::MAX))
        });
        // It replies at the deadline; without a reply, the reason would be unknown.
        let wait = until.map(|until| until + REPLY_TIMEOUT);
        let called = self.client.call(call, deadline_ns, wait);
        if !matches!(called, Ok(ModelWait::Reply(..)) | Err(LinkError::TooLong { .. })) {
            (self.inputs, self.outputs) = (None, None);
        }
        let ModelWait::Reply(reply, region) = called.map_err(failed)? else {
            return Err(InferenceError::OutOfTime);
        };
        if reply.id == 0 {
            self.note(&reply);
        }
        match reply.result {
            // The process has started again, without this call.
            Ok(ModelResult::Started) => Err(InferenceError::Restarted),
            Ok(result) => Ok((result, region)),
            Err(ModelFault { kind, message }) => Err(InferenceError::of(kind, message)),
        }
    }
}

fn not_connected() -> InferenceError {
    InferenceError::Unavailable(
        "no process runs models: start the lambda with `gleaner run` or `gleaner replay`"
            .to_owned(),
    )
}

fn failed(error: LinkError) -> InferenceError {
    InferenceError::Unavailable(chain(&error))
}

fn region_failed(error: io::Error) -> InferenceError {
    InferenceError::Unavailable(format!("cannot use the memory of gleaner-inference: {error}"))
}

fn unexpected() -> InferenceError {
    InferenceError::Unavailable("gleaner-inference sent an invalid reply".to_owned())
}

#[cfg(test)]
mod tests;
