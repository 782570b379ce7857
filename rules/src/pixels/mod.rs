//! The pixels of a frame: the interpretation of image messages ([`Encoding`], [`View`]) and the
//! operations that the host offers to lambdas ([`ops`]).
//!
//! All code works on slices of the caller, and all arithmetic on pixels is in integers, so that a
//! result is equal on every CPU and in every replay.
//!
//! No number from a message is used before it is checked against the available bytes. There is no
//! floating point, except for one last division.

mod encoding;
mod error;
pub mod ops;
mod stop_check;
mod view;

pub use encoding::{Bayer, Encoding};
pub use error::{PixelError, PixelErrorKind};
pub use stop_check::StopCheck;
pub use view::{MAX_SIDE, Roi, View, check_size};
