//! The room where a frame is pixels.
//!
//! Inside: what an image message means ([`Encoding`], [`View`]), how JPEG and PNG bytes become rgb8
//! ([`probe`], [`decode_rgb8`]), and the operations that the host offers to lambdas ([`ops`]). All of
//! it works on plain slices that the caller owns, and all arithmetic on pixels is in integers, so
//! that a result is equal on every CPU and in every replay.
//!
//! Never: a number out of a header that is used before it is checked against the bytes that are
//! really there and against the limit of the caller; memory in proportion to what a header claims;
//! the `format` string of a `CompressedImage`, which lies; floating point, before one last division.

mod decode;
mod encoding;
mod error;
pub mod ops;
mod pace;
mod view;

pub use decode::{Format, Header, decode_rgb8, decode_rgb8_paced, probe};
pub use encoding::{Bayer, Encoding};
pub use error::{ImageError, ImageErrorKind};
pub use pace::Pace;
pub use view::{MAX_SIDE, Roi, View};
