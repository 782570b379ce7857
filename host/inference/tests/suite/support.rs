//! The program, its starter, and lambdas.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use gleaner_protocol::Handover;
use gleaner_protocol::inference::{
    AddClient, Element, GrantedModel, InferenceControl, InferenceReport, InferenceStatus,
    LoadedModel, MAX_TENSOR_BYTES, ModelCall, ModelClient, ModelEngine, ModelFault, ModelFaultKind,
    ModelFile, ModelResult, ModelState, ModelWait, TensorInfo, TensorPlace, models_in_use,
};
use sha2::{Digest, Sha256};

use gleaner_test_support::onnx::product;
use gleaner_test_support::shared_file;

/// Time after which an awaited event is missing.
pub const TIMEOUT: Duration = Duration::from_secs(60);

/// A started program; killed when it is dropped.
pub struct ModelProgram {
    child: Child,
    pub control: Option<InferenceControl>,
    _handover: UnixStream,
    reports: Receiver<InferenceReport>,
    running: File,
    /// That of further lambdas.
    pub demand: Option<u64>,
}

/// A model, as the starter grants it.
#[derive(Clone)]
pub struct TestModel {
    pub grant: GrantedModel,
    pub bytes: Vec<u8>,
}

/// Returns the SHA-256 of bytes, in hexadecimal digits.
pub fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns a model that runs by rten, whatever this machine has.
pub fn granted(name: &str, bytes: Vec<u8>) -> TestModel {
    let grant = GrantedModel {
        name: name.to_owned(),
        sha256: digest(&bytes),
        providers: vec!["rten".to_owned()],
        threads: None,
        refused: None,
    };
    TestModel { grant, bytes }
}

impl ModelProgram {
    pub fn start(args: &[&str]) -> Self {
        let (handover, stdin) = UnixStream::pair().unwrap();
        let (control, end) = InferenceControl::pair().unwrap();
        let running = tempfile::tempfile().unwrap();
        let connections = Handover {
            control: Some(end),
            running: Some(running.try_clone().unwrap().into()),
            ..Handover::default()
        };
        connections.send(&handover).unwrap();
        drop(connections);
        let mut child = Command::new(env!("CARGO_BIN_EXE_gleaner-inference"))
            .args(args)
            .env_remove("ORT_DYLIB_PATH")
            .env_remove("VIRTUAL_ENV")
            .env("ORT_DISABLE_TELEMETRY", "1")
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, reports) = channel();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                if sender.send(serde_json::from_str(&line).unwrap()).is_err() {
                    return;
                }
            }
        });
        Self { child, control: Some(control), _handover: handover, reports, running, demand: None }
    }

    /// Adds a lambda with its models.
    pub fn lambda(&self, name: &str, models: &[TestModel]) -> ModelUser {
        ModelUser::new(self.connect(name, models))
    }

    /// Adds a lambda with its models; returns its socket.
    pub fn connect(&self, name: &str, models: &[TestModel]) -> OwnedFd {
        let (lambda, other) = ModelClient::pair().unwrap();
        self.add(name, models, &other);
        lambda
    }

    /// Adds a lambda whose process has the other end of `socket`.
    pub fn add(&self, name: &str, models: &[TestModel], socket: &OwnedFd) {
        let control = self.control.as_ref().unwrap();
        for TestModel { grant, bytes } in models {
            let mut file = tempfile::tempfile().unwrap();
            file.write_all(bytes).unwrap();
            let path = format!("{}.onnx", grant.name);
            let engine = ModelEngine::None;
            let model = ModelFile { sha256: grant.sha256.clone(), path, engine };
            control.add_model(&model, file.as_fd(), None).unwrap();
        }
        let models = models.iter().map(|model| model.grant.clone()).collect();
        let (id, name, memory) = (name.to_owned(), name.to_owned(), MAX_TENSOR_BYTES);
        let client = AddClient { id, name, demand: self.demand, pace: None, memory, models };
        control.add_client(&client, socket.as_fd()).unwrap();
    }

    /// Checks that it still serves other lambdas.
    pub fn serves(&self) {
        let mut lambda = self.lambda("healthy", &[granted("product", product())]);
        lambda.open("product").unwrap();
        let outputs = lambda.run("product", &[floats("x", &[1, 3], &[1.0; 3])]).unwrap();
        assert_eq!(outputs[0].floats(), [9.0, 12.0]);
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn report<T>(&self, mut find: impl FnMut(InferenceReport) -> Option<T>) -> T {
        loop {
            if let Some(found) = find(self.reports.recv_timeout(TIMEOUT).expect("a report")) {
                return found;
            }
        }
    }

    /// Waits for the report of a model that was loaded or failed.
    pub fn loaded(&self) -> LoadedModel {
        self.report(|report| match report {
            InferenceReport::Model(model) if model.state != ModelState::Warming => Some(model),
            _ => None,
        })
    }

    /// Waits for a status that is as expected.
    pub fn status(&self, is_it: impl Fn(&InferenceStatus) -> bool) -> InferenceStatus {
        self.report(|report| match report {
            InferenceReport::Status(status) if is_it(&status) => Some(status),
            _ => None,
        })
    }

    /// Returns the digests of the models that are being loaded and run.
    pub fn in_use(&self) -> [Option<String>; 2] {
        let notes = models_in_use(&self.running);
        [false, true].map(|runs| {
            let note = notes.iter().find(|note| note.contains(' ') == runs)?;
            note.split(' ').next().map(str::to_owned)
        })
    }

    /// Returns what its pipe of standard error holds.
    pub fn unread_log(&self) -> String {
        let mut text = vec![0; 64 << 10];
        let read = rustix::io::read(self.child.stderr.as_ref().unwrap(), &mut text).unwrap();
        String::from_utf8_lossy(&text[..read]).into_owned()
    }

    /// Waits for the end; returns the exit status and standard error.
    pub fn end(&mut self) -> (ExitStatus, String) {
        let status = wait_for(|| self.child.try_wait().unwrap());
        let mut errors = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut errors).unwrap();
        (status, errors)
    }

    /// Requests the end; returns the last status.
    pub fn stop(mut self) -> InferenceStatus {
        self.control.as_ref().unwrap().stop().unwrap();
        let last = self.report(|report| match report {
            InferenceReport::Ended(status) => Some(status),
            _ => None,
        });
        let (status, errors) = self.end();
        assert!(status.success(), "{status} {errors}");
        last
    }
}

impl Drop for ModelProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct TestTensor {
    pub name: String,
    pub element: Element,
    pub shape: Vec<u32>,
    pub bytes: Vec<u8>,
}

pub fn floats(name: &str, shape: &[u32], values: &[f32]) -> TestTensor {
    let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    TestTensor { name: name.to_owned(), element: Element::Float32, shape: shape.to_vec(), bytes }
}

pub fn integers(name: &str, shape: &[u32], values: &[i64]) -> TestTensor {
    let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    TestTensor { name: name.to_owned(), element: Element::Int64, shape: shape.to_vec(), bytes }
}

impl TestTensor {
    pub fn floats(&self) -> Vec<f32> {
        assert_eq!(self.element, Element::Float32);
        self.bytes.as_chunks().0.iter().map(|chunk| f32::from_le_bytes(*chunk)).collect()
    }

    pub fn place(&self, offset: u64) -> TensorPlace {
        let (name, shape) = (self.name.clone(), self.shape.clone());
        TensorPlace { name, element: self.element, shape, offset }
    }
}

#[derive(Debug)]
pub struct OpenedModel {
    pub inputs: Vec<TensorInfo>,
    pub outputs: Vec<TensorInfo>,
    pub runtime: String,
}

/// A lambda's process.
pub struct ModelUser {
    pub client: ModelClient,
    inputs: Option<File>,
    outputs: Option<File>,
    /// Run time of the model in the last run.
    pub run_ns: u64,
}

/// Returns a time of CLOCK_MONOTONIC, in ns.
pub fn in_future(after: Duration) -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64 + after.as_nanos() as u64
}

impl ModelUser {
    pub fn new(socket: OwnedFd) -> Self {
        Self { client: ModelClient::new(socket), inputs: None, outputs: None, run_ns: 0 }
    }

    /// Makes a call, and waits for its reply.
    pub fn call(
        &mut self,
        call: ModelCall,
        deadline: Option<Duration>,
    ) -> (Result<ModelResult, ModelFault>, Option<OwnedFd>) {
        let until = Some(Instant::now() + TIMEOUT);
        match self.client.call(call, deadline.map(in_future), until) {
            Ok(ModelWait::Reply(reply, region)) => (reply.result, region),
            Ok(ModelWait::TimedOut) => panic!("no reply"),
            Err(error) => panic!("{error}"),
        }
    }

    pub fn open(&mut self, model: &str) -> Result<OpenedModel, ModelFault> {
        self.open_until(model, None)
    }

    pub fn open_until(
        &mut self,
        model: &str,
        deadline: Option<Duration>,
    ) -> Result<OpenedModel, ModelFault> {
        match self.call(ModelCall::Open { model: model.to_owned() }, deadline).0? {
            ModelResult::Opened { inputs, outputs, runtime, .. } => {
                Ok(OpenedModel { inputs, outputs, runtime })
            }
            other => panic!("{other:?}"),
        }
    }

    pub fn reserve(&mut self, bytes: u64) -> Result<(), ModelFault> {
        let (result, region) = self.call(ModelCall::Reserve { bytes }, None);
        assert_eq!(result?, ModelResult::Reserved);
        self.inputs = Some(File::from(region.expect("a region")));
        Ok(())
    }

    /// Writes inputs to the region; returns their places.
    pub fn place(&mut self, inputs: &[TestTensor]) -> Vec<TensorPlace> {
        let mut end = 0_u64;
        let mut places = Vec::new();
        for input in inputs {
            places.push(input.place(end));
            end = (end + input.bytes.len() as u64).next_multiple_of(64);
        }
        let has_room = self
            .inputs
            .as_mut()
            .is_some_and(|region| region.seek(SeekFrom::End(0)).unwrap() >= end);
        if !has_room {
            self.reserve(end.max(64)).unwrap();
        }
        let region = self.inputs.as_ref().unwrap();
        for (input, place) in inputs.iter().zip(&places) {
            region.write_all_at(&input.bytes, place.offset).unwrap();
        }
        places
    }

    pub fn run(
        &mut self,
        model: &str,
        inputs: &[TestTensor],
    ) -> Result<Vec<TestTensor>, ModelFault> {
        self.run_until(model, inputs, None)
    }

    pub fn run_until(
        &mut self,
        model: &str,
        inputs: &[TestTensor],
        deadline: Option<Duration>,
    ) -> Result<Vec<TestTensor>, ModelFault> {
        let inputs = self.place(inputs);
        self.run_at(model, inputs, deadline)
    }

    pub fn run_at(
        &mut self,
        model: &str,
        inputs: Vec<TensorPlace>,
        deadline: Option<Duration>,
    ) -> Result<Vec<TestTensor>, ModelFault> {
        let call = ModelCall::Run { model: model.to_owned(), inputs };
        let (result, region) = self.call(call, deadline);
        if let Some(region) = region {
            self.outputs = Some(File::from(region));
        }
        let ModelResult::Ran { outputs, run_ns } = result? else { panic!("another reply") };
        self.run_ns = run_ns;
        let region = self.outputs.as_ref().expect("a region of outputs");
        let read = |place: TensorPlace| {
            assert!(place.offset.is_multiple_of(64));
            let mut bytes = vec![0; place.bytes().unwrap() as usize];
            region.read_exact_at(&mut bytes, place.offset).unwrap();
            let TensorPlace { name, element, shape, .. } = place;
            TestTensor { name, element, shape, bytes }
        };
        Ok(outputs.into_iter().map(read).collect())
    }
}

/// Returns the message of a fault of this kind.
#[track_caller]
pub fn fault<T: std::fmt::Debug>(kind: ModelFaultKind, result: Result<T, ModelFault>) -> String {
    let fault = result.unwrap_err();
    assert_eq!(fault.kind, kind, "{}", fault.message);
    fault.message
}

pub fn wait_for<T>(mut find: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + TIMEOUT;
    loop {
        if let Some(found) = find() {
            return found;
        }
        assert!(Instant::now() < until, "it did not happen in time");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Returns a file of the shared test data, if there is one.
pub fn shared(path: &str) -> Option<PathBuf> {
    shared_file(path).inspect_err(|why| println!("skipped: {why}")).ok()
}
