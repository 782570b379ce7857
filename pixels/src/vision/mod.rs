//! Turns frames into input tensors of models, and outputs of detectors into boxes.
//!
//! [`Preparer`] resizes a frame, rearranges its channels and scales its values, as [`Preprocess`]
//! states, into bytes of the caller. [`DetectorLayout`] knows how the common families of detectors
//! want their input, and [`detect`] reads their outputs. All functions work on slices, and use no
//! file, no thread and no clock.
//!
//! A tensor is the same on every CPU: pixels are blended in integers, and each value is scaled once
//! in plain `f32`. So are the boxes of a detector, except where [`DetectorLayout::Yolox`] and
//! [`DetectorLayout::Nanodet`] need `exp`, whose last bit may depend on the platform.
//!
//! No number of a model or of a message is used before it is checked, and the work on outputs of a
//! model is bounded: it grows with their length, not with its square.

mod bilinear;
mod detect;
mod error;
mod export;
mod heads;
mod layout;
mod placement;
mod prepare;

pub use detect::{Detection, MAX_CANDIDATES, MAX_DETECTIONS, OutputView, Wanted, detect};
pub use error::VisionError;
pub use export::ExportNote;
pub use layout::DetectorLayout;
pub use placement::{MAX_TENSOR_SIDE, Placed, Placement};
pub use prepare::{Preparer, Preprocess};
