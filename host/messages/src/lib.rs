//! ROS 2 messages without code generation: definitions from text, fields by compiled path.
//!
//! [`Definitions`] is a message type with all types it refers to, parsed from the ros2msg text of
//! an MCAP schema or of `.msg` files. [`FieldPath`] is one field of it, compiled once into a short
//! skip program; reading it from CDR bytes runs that program and borrows from the bytes.
//! [`ImageView`] and [`CompressedView`] read the two image types as a whole. [`Sources`] finds the
//! text of types that no recording carries: in folders, bundled, or installed.
//!
//! No message, whatever its bytes claim, causes a panic or an allocation larger than itself. No
//! message type is treated specially, apart from the two views and the header stamp. XCDR2 and
//! parameter lists are not supported (ROS 2 uses classic CDR).
//!
//! [`transport`] has the traits of sources of such messages.

mod cdr;
mod definitions;
mod encode;
mod layout;
mod parse;
mod path;
mod program;
mod sources;
mod stamp;
pub mod transport;
pub mod type_description;
mod value;
mod views;

pub use cdr::{CdrError, Endian};
pub use definitions::{Definitions, MessageError, short_name};
pub use encode::CdrWriter;
pub use path::{FieldPath, PathError};
pub use sources::{Sources, SourcesError};
pub use stamp::{HeaderStamp, header_stamp};
pub use value::{MessageValue, ValueKind};
pub use views::{CompressedView, ImageView, is_viewed};
