//! ROS 2 messages without code generation: definitions from text, fields by compiled path.
//!
//! [`Definitions`] is a message type and everything it refers to, parsed from the ros2msg text that
//! an MCAP schema or a folder of `.msg` files carries. [`FieldPath`] is one field of it, compiled
//! once into a short skip program; reading it from CDR bytes walks that program and borrows from
//! the bytes. [`ImageView`] and [`CompressedView`] are the two types that image work needs whole.
//! [`Sources`] finds the text where no recording brings it: in folders, bundled, or installed.
//!
//! What never happens here: a panic, or an allocation larger than the message, whatever the bytes
//! claim; knowledge of a particular message type, apart from the two views and the header stamp;
//! XCDR2 and parameter lists (ROS 2 uses classic CDR).

mod cdr;
mod definitions;
pub mod described;
mod encode;
mod layout;
mod parse;
mod path;
mod program;
mod sources;
mod stamp;
mod value;
mod views;

pub use cdr::{CdrError, Endian};
pub use definitions::{Definitions, MessageError, short_name};
pub use encode::CdrWriter;
pub use path::{FieldPath, PathError};
pub use sources::{Sources, SourcesError};
pub use stamp::{HeaderStamp, header_stamp};
pub use value::{Kind, Value};
pub use views::{CompressedView, ImageView};
