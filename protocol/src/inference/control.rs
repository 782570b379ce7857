//! Requests of the starter: the models that exist, and the lambdas that may use them.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{INFERENCE, ModelMemory, TryLoad};
use crate::link::frame::{self, tag};
use crate::link::{
    FrameReceiver, Incoming, LinkError, ReceivedFrame, STARTER, send_frame, send_json,
};

/// Time to wait while the process does not read.
const TIMEOUT: Duration = Duration::from_secs(10);

/// A model file. It comes as a descriptor; its digest is checked before it is loaded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelFile {
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
    /// Its path, for messages.
    pub path: String,
    /// Its engine for TensorRT.
    pub engine: ModelEngine,
}

/// The engine for TensorRT that was built of a model.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelEngine {
    /// There is none.
    #[default]
    None,
    /// Its entry in the store comes as a second descriptor; it is verified before it is loaded.
    Attached,
    /// It must not be used, for this reason.
    Refused(String),
}

/// Returns the name of the file with the engine that was built of the model with this SHA-256, in
/// the folder of `--build-engines`.
pub fn engine_file(sha256: &str) -> String {
    format!("{sha256}.onnx")
}

/// A model that a lambda may use.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct GrantedModel {
    /// Its name in the manifest.
    pub name: String,
    /// SHA-256 of its file.
    pub sha256: String,
    /// Execution providers in order of preference; empty for any.
    pub providers: Vec<String>,
    /// Threads of one run; `None` for 1.
    pub threads: Option<u32>,
    /// The reason why the lambda must not use it: it has ended the process several times.
    pub refused: Option<String>,
}

impl GrantedModel {
    /// Returns its load, which lambdas share that grant the same.
    pub fn load(&self) -> TryLoad {
        /// Largest number of threads of one run.
        const MAX_THREADS: u32 = 64;
        TryLoad {
            sha256: self.sha256.clone(),
            providers: self.providers.clone(),
            threads: self.threads.unwrap_or(1).clamp(1, MAX_THREADS),
        }
    }
}

/// A lambda's process, which comes as the descriptor of its connection.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddClient {
    /// Identity of the lambda, also over its restarts: it is beyond its demand under it.
    pub id: String,
    /// Name of the lambda, for messages.
    pub name: String,
    /// The time of models in a wake that it has stated, in ns.
    pub demand: Option<u64>,
    /// The time of models in a wake, and that from wake to wake, if the latter is stated; in ns.
    /// Live, its runs wait beyond twice that.
    pub pace: Option<[u64; 2]>,
    /// Its memory, in bytes: the largest size of its inputs, and of its outputs.
    pub memory: u64,
    /// The models that it may use.
    pub models: Vec<GrantedModel>,
}

/// A request of the starter.
#[derive(Debug)]
pub enum InferenceRequest {
    /// A model file and its engine, sent before each lambda that may use it.
    Model(ModelFile, OwnedFd, Option<OwnedFd>),
    /// A lambda.
    Client(AddClient, OwnedFd),
    /// A load that it has requested a trial of, the reason why it must not happen, if any, and the
    /// memory that it took.
    Tried(TryLoad, Option<String>, ModelMemory),
    /// Exit.
    Stop,
}

/// The starter's end of the control connection. Its calls wait while the process does not read, up
/// to 10 s.
#[derive(Debug)]
pub struct InferenceControl {
    socket: UnixStream,
}

impl InferenceControl {
    /// Creates a connection; also returns the end of the process.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn pair() -> io::Result<(InferenceControl, OwnedFd)> {
        let (starter_end, other_end) = UnixStream::pair()?;
        starter_end.set_write_timeout(Some(TIMEOUT))?;
        Ok((InferenceControl { socket: starter_end }, other_end.into()))
    }

    /// Adds a model file, with its engine if that is attached.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the process has ended, [`LinkError::Full`] if it does not read.
    pub fn add_model(
        &self,
        model: &ModelFile,
        file: BorrowedFd<'_>,
        engine: Option<BorrowedFd<'_>>,
    ) -> Result<(), LinkError> {
        let descriptors: Vec<_> = [file].into_iter().chain(engine).collect();
        send_json(&self.socket, tag::MODEL_FILE, model, &descriptors, INFERENCE)
    }

    /// Adds a lambda, whose process has the other end of `socket`.
    ///
    /// # Errors
    ///
    /// Those of [`add_model`](Self::add_model).
    pub fn add_client(&self, client: &AddClient, socket: BorrowedFd<'_>) -> Result<(), LinkError> {
        send_json(&self.socket, tag::ADD_CLIENT, client, &[socket], INFERENCE)
    }

    /// Sends the result of a trial: the reason why the load must not happen, if there is one, and
    /// the memory that it took.
    ///
    /// # Errors
    ///
    /// Those of [`add_model`](Self::add_model).
    pub fn tried(
        &self,
        load: &TryLoad,
        refused: Option<&str>,
        memory: ModelMemory,
    ) -> Result<(), LinkError> {
        send_json(&self.socket, tag::TRIED_LOAD, &(load, refused, memory), &[], INFERENCE)
    }

    /// Requests the process to exit.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended.
    pub fn stop(&self) -> Result<(), LinkError> {
        send_frame(&self.socket, &frame::encode(tag::STOP, &[]), &[], INFERENCE)
    }
}

/// The end of `gleaner-inference` of the control connection.
///
/// Its descriptor is readable when [`poll`](Self::poll) has something to read.
#[derive(Debug)]
pub struct InferenceServer {
    socket: OwnedFd,
    frames: FrameReceiver,
}

impl InferenceServer {
    /// Creates the server from its end of the connection.
    pub fn new(socket: OwnedFd) -> InferenceServer {
        InferenceServer { socket, frames: FrameReceiver::new(STARTER, 2) }
    }

    /// Returns the next request if it has arrived completely. Never waits. Call it until it returns
    /// no message.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it.
    pub fn poll(&mut self) -> Result<Incoming<InferenceRequest>, LinkError> {
        self.frames.poll(&self.socket, request)
    }
}

impl AsFd for InferenceServer {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

fn request(mut frame: ReceivedFrame) -> Result<InferenceRequest, LinkError> {
    match frame.tag {
        tag::MODEL_FILE => {
            let model: ModelFile = frame.json(STARTER)?;
            // The last one comes first.
            let is_attached = model.engine == ModelEngine::Attached;
            let engine = is_attached.then(|| frame.descriptor()).transpose()?;
            Ok(InferenceRequest::Model(model, frame.descriptor()?, engine))
        }
        tag::ADD_CLIENT => Ok(InferenceRequest::Client(frame.json(STARTER)?, frame.descriptor()?)),
        tag::TRIED_LOAD => {
            let (load, refused, memory) = frame.json(STARTER)?;
            Ok(InferenceRequest::Tried(load, refused, memory))
        }
        tag::STOP => Ok(InferenceRequest::Stop),
        tag => Err(LinkError::Unknown { peer: STARTER, tag }),
    }
}
