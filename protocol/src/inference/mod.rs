//! Messages to and from `gleaner-inference`, the process that runs models for all lambdas.
//!
//! The program that starts it creates a pair of sockets for each lambda, and passes one end to
//! `gleaner-inference` with the models that the lambda may use. So no process listens on a socket,
//! a lambda can only run its own models, and the socket itself identifies the lambda.
//!
//! - `tensor`: types and places of tensors.
//! - `call`: what a lambda's process requests, and the replies.
//! - `client`: the lambda's end: [`ModelClient`]. `server`: the other one: [`ModelSocket`].
//! - `control`: from the starter: [`InferenceControl`] and [`InferenceServer`].
//! - `report`: to the starter, as lines of JSON on standard output.
//!
//! Tensors lie in shared memory: `gleaner-inference` creates a region for the inputs and one for
//! the outputs of each lambda, seals their size, and sends them with a reply. It trusts no byte of
//! the inputs, which the lambda's process may change at any time, and copies them first.

mod call;
mod client;
mod control;
mod report;
mod server;
mod tensor;
#[cfg(test)]
mod tests;

pub use call::{ModelCall, ModelFault, ModelFaultKind, ModelReply, ModelRequest, ModelResult};
pub use client::{ModelClient, ModelWait};
pub use control::{
    AddClient, GrantedModel, InferenceControl, InferenceRequest, InferenceServer, ModelEngine,
    ModelFile, engine_file,
};
pub use report::{
    InferenceReport, InferenceStatus, LoadedModel, MODEL_WORKERS, ModelMemory, ModelState,
    NOTE_BYTES, TryLoad, models_in_use,
};
pub use server::{ModelSocket, report_state};
pub use tensor::{
    Element, MAX_DIMENSIONS, MAX_TENSOR_BYTES, TENSOR_ALIGNMENT, TensorInfo, TensorPlace,
};

/// Name of the process in messages.
const INFERENCE: &str = "gleaner-inference";

/// Longest message of a lambda's connection, in bytes. A socket sends such a message as a whole.
pub const MESSAGE_MAX: usize = 64 << 10;
