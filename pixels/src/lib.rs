//! Decodes compressed frames into pixels; [`vision`] makes tensors of frames, and boxes of outputs.
//!
//! JPEG and PNG bytes become rgb8, a grey PNG of 16 bits becomes mono16 ([`probe`], [`decode()`]).
//! Pixels and operations on them ([`Encoding`], [`View`], [`ops`]) are those of
//! `gleaner_rules::pixels`, re-exported here. All functions work on slices of the caller, and
//! return the same result on every CPU and in every replay.
//!
//! No number of a header is used before it is checked against the bytes and the caller's limit, and
//! memory does not depend on what a header claims. The bytes of a `CompressedImage` decide what it
//! is; its `format` must not contradict them ([`probe_message`]).

mod decode;
pub mod vision;

pub use decode::{Format, ImageError, ImageHeader, decode, decode_rgb8, probe, probe_message};
pub use gleaner_rules::pixels::{
    Bayer, Encoding, MAX_SIDE, PixelError, PixelErrorKind, Roi, StopCheck, View, ops,
};
