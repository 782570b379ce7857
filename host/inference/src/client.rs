//! A connected lambda: its socket, the models that it may use, its regions, and its call.

use std::collections::{HashMap, HashSet};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;

use gleaner_protocol::inference::{
    AddClient, GrantedModel, MAX_TENSOR_BYTES, ModelFault, ModelFaultKind, ModelReply,
    ModelRequest, ModelResult, ModelSocket,
};
use gleaner_protocol::link::{Incoming, LinkError};
use tracing::warn;

use crate::loader::PassedModel;
use crate::region::TensorRegion;
use crate::sessions::{SessionId, SessionKey};

/// Messages of a lambda that are read in one second; a lambda makes a few for each wake.
const MESSAGES_PER_SECOND: u32 = 2000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct LambdaId(pub(crate) u64);

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OpenCall {
    pub(crate) id: u64,
    /// Time of CLOCK_MONOTONIC, in ns.
    pub(crate) deadline_ns: Option<u64>,
    /// Name of the model in the manifest.
    pub(crate) model: String,
    pub(crate) session: SessionId,
    /// Id of the region for outputs that the lambda has.
    pub(crate) outputs: u64,
    pub(crate) stage: CallStage,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CallStage {
    Loading,
    /// The run waits for others.
    Waiting,
    /// The run is in progress, with the number of its job.
    Running(u64),
}

/// A model that the lambda may use.
#[derive(Debug)]
pub(crate) struct GrantedSession {
    pub(crate) key: SessionKey,
    /// The reason why it must not be loaded.
    pub(crate) refused: Option<String>,
}

#[derive(Debug)]
pub(crate) struct ConnectedLambda {
    /// Its identity, by which its time is counted.
    pub(crate) id: String,
    pub(crate) name: String,
    /// Largest size of its inputs, and of its outputs, in bytes.
    pub(crate) memory: u64,
    socket: ModelSocket,
    models: HashMap<String, GrantedSession>,
    pub(crate) files: Vec<PassedModel>,
    /// Names of the models that it has opened.
    pub(crate) opened: HashSet<String>,
    pub(crate) call: Option<OpenCall>,
    pub(crate) inputs: Option<Arc<TensorRegion>>,
    pub(crate) outputs: Option<Arc<TensorRegion>>,
    last_id: u64,
    /// Messages that may still be read in this second.
    messages_left: u32,
    /// Set once it is not served any more.
    pub(crate) is_gone: bool,
}

impl ConnectedLambda {
    pub(crate) fn new(add: AddClient, socket: OwnedFd, files: Vec<PassedModel>) -> Self {
        let granted = |model: GrantedModel| {
            let key = model.load();
            (model.name, GrantedSession { key, refused: model.refused })
        };
        Self {
            id: add.id,
            name: add.name,
            memory: add.memory.min(MAX_TENSOR_BYTES),
            socket: ModelSocket::new(socket),
            models: add.models.into_iter().map(granted).collect(),
            files,
            opened: HashSet::new(),
            call: None,
            inputs: None,
            outputs: None,
            last_id: 0,
            messages_left: MESSAGES_PER_SECOND,
            is_gone: false,
        }
    }

    /// Returns the session of a model; `None` if it was not granted.
    pub(crate) fn granted(&self, model: &str) -> Option<&GrantedSession> {
        self.models.get(model)
    }

    pub(crate) fn uses(&self, key: &SessionKey) -> bool {
        self.models.values().any(|granted| granted.key == *key && granted.refused.is_none())
    }

    /// Returns whether it may send a message in this second.
    pub(crate) fn may_send(&self) -> bool {
        self.messages_left > 0
    }

    /// Begins a second.
    pub(crate) fn reset_messages(&mut self) {
        self.messages_left = MESSAGES_PER_SECOND;
    }

    /// Returns its next request. A lambda that sends anything else is gone.
    pub(crate) fn request(&mut self) -> Option<ModelRequest> {
        self.messages_left = self.messages_left.saturating_sub(1);
        match self.socket.poll() {
            Ok(Incoming::Message(request)) if request.id > self.last_id => {
                self.last_id = request.id;
                Some(request)
            }
            Ok(Incoming::Message(request)) => {
                let (id, last) = (request.id, self.last_id);
                self.drop_for(&format!("its call {id} came after call {last}"));
                None
            }
            Ok(Incoming::Nothing) => None,
            Ok(Incoming::Ended) => {
                self.is_gone = true;
                None
            }
            Err(error) => {
                self.drop_for(&error.to_string());
                None
            }
        }
    }

    /// Stops serving it, and logs the reason.
    pub(crate) fn drop_for(&mut self, reason: &str) {
        if !self.is_gone {
            warn!(lambda = self.name, reason, "connection to a lambda closed");
        }
        self.is_gone = true;
    }

    /// Sends a reply, with the region `region` if the lambda has another one, whose id is `known`.
    /// A lambda that does not read its replies is gone.
    pub(crate) fn reply(
        &mut self,
        id: u64,
        result: Result<ModelResult, ModelFault>,
        region: Option<&TensorRegion>,
        known: u64,
    ) {
        let region_id = region.map_or(0, |region| region.id);
        let region = region.filter(|region| region.id != known).map(AsFd::as_fd);
        let mut sent = self.socket.reply(&ModelReply { id, region: region_id, result }, region);
        if let Err(LinkError::TooLong { bytes, max, .. }) = sent {
            let message = format!("the reply has {bytes} bytes; {max} are allowed");
            let result = Err(ModelFault::new(ModelFaultKind::Failed, message));
            sent = self.socket.reply(&ModelReply { id, region: 0, result }, None);
        }
        match sent {
            Ok(()) => {}
            Err(LinkError::Gone { .. }) => self.is_gone = true,
            Err(error) => self.drop_for(&error.to_string()),
        }
    }

    /// Sends its region for inputs, and creates a larger one if needed.
    pub(crate) fn reserve(&mut self, call: u64, bytes: u64) {
        if bytes == 0 || bytes > self.memory {
            let allowed = format!("1 to {}, its `memory`, are allowed", self.memory);
            let message = format!("a region of {bytes} bytes is requested; {allowed}");
            return self.fail(call, ModelFaultKind::WrongInput, message);
        }
        let known = self.inputs.clone().filter(|region| region.bytes() >= bytes);
        let region =
            known.map_or_else(|| TensorRegion::create("gleaner-inputs", bytes).map(Arc::new), Ok);
        match region {
            Ok(region) => {
                self.reply(call, Ok(ModelResult::Reserved), Some(&region), 0);
                self.inputs = Some(region);
            }
            Err(error) => {
                let message = format!("the memory for inputs cannot be created: {error}");
                self.fail(call, ModelFaultKind::Failed, message);
            }
        }
    }

    /// Sends the reply of a call that failed.
    pub(crate) fn fail(&mut self, id: u64, kind: ModelFaultKind, message: impl Into<String>) {
        self.reply(id, Err(ModelFault::new(kind, message)), None, 0);
    }
}

impl AsFd for ConnectedLambda {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}
