//! Bindings that wasmtime generates from `wit/`, with the host's types behind the handles.

use std::sync::Arc;

/// Handle types, under the names that [`wasmtime::component::bindgen`] wants as paths.
pub mod handles {
    use super::Arc;
    use crate::api;

    pub type Topic = Arc<api::data::Topic>;
    pub use api::data::{Field, Sample};
    pub use api::frame::Frame;
    pub use api::inference::{Model, Tensor};
}

wasmtime::component::bindgen!({
    path: "../wit",
    world: "lambda",
    imports: { default: trappable },
    with: {
        "gleaner:lambda/data.topic": handles::Topic,
        "gleaner:lambda/data.field": handles::Field,
        "gleaner:lambda/data.sample": handles::Sample,
        "gleaner:lambda/data.frame": handles::Frame,
        "gleaner:lambda/inference.tensor": handles::Tensor,
        "gleaner:lambda/inference.model": handles::Model,
    },
});
