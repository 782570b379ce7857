//! The room where a compressed frame becomes pixels.
//!
//! Inside: how JPEG and PNG bytes become rgb8 ([`probe`], [`decode_rgb8`]). What pixels are and
//! what is computed on them ([`Encoding`], [`View`], [`ops`]) is `gleaner_rules::pixels`, under the
//! names of this crate. All of it works on plain slices that the caller owns, and gives the same
//! result on every CPU and in every replay.
//!
//! Never: a number out of a header that is used before it is checked against the bytes that are
//! really there and against the limit of the caller; memory in proportion to what a header claims;
//! the `format` string of a `CompressedImage`, which lies.

mod decode;
mod error;

pub use decode::{Format, Header, decode_rgb8, decode_rgb8_paced, probe};
pub use error::ImageError;
pub use gleaner_rules::pixels::{
    Bayer, Encoding, MAX_SIDE, Pace, PixelError, PixelErrorKind, Roi, View, ops,
};
