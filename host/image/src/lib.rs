//! Decodes compressed frames into pixels.
//!
//! JPEG and PNG bytes become rgb8 ([`probe`], [`decode_rgb8`]). Pixels and operations on them
//! ([`Encoding`], [`View`], [`ops`]) are those of `gleaner_rules::pixels`, re-exported here. All
//! functions work on slices that the caller owns, and return the same result on every CPU and in
//! every replay.
//!
//! No number of a header is used before it is checked against the bytes and the caller's limit, and
//! memory does not depend on what a header claims. The `format` string of a `CompressedImage` is
//! ignored: it may be wrong.

mod decode;
mod error;

pub use decode::{Format, ImageHeader, decode_rgb8, decode_rgb8_paced, probe};
pub use error::ImageError;
pub use gleaner_rules::pixels::{
    Bayer, Encoding, MAX_SIDE, PixelError, PixelErrorKind, Roi, StopCheck, View, ops,
};
