//! A frame as pixels: what an image message means ([`Encoding`], [`View`]) and the operations that
//! the host offers to lambdas ([`ops`]).
//!
//! All of it works on plain slices that the caller owns, and all arithmetic on pixels is in
//! integers, so that a result is equal on every CPU and in every replay.
//!
//! Never: a number out of a message that is used before it is checked against the bytes that are
//! really there; floating point, before one last division.

mod encoding;
mod error;
pub mod ops;
mod stop_check;
mod view;

pub use encoding::{Bayer, Encoding};
pub use error::{PixelError, PixelErrorKind};
pub use stop_check::StopCheck;
pub use view::{MAX_SIDE, Roi, View, check_size};
