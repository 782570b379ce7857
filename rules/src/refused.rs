//! Why a read of data is refused, in words for the lambda's author, where they are no rule's own.

use std::fmt::Display;

use crate::text::{RoundedBytes, quoted};

/// No input has that name.
pub fn no_such_input<S: AsRef<str>>(asked: &str, known: impl IntoIterator<Item = S>) -> String {
    let asked = asked.chars().take(64).collect::<String>();
    format!("no input `{asked}`; the manifest has {}", quoted(known))
}

/// The bytes of a message are none of its type.
pub fn malformed(topic: &str, type_name: &str, why: impl Display) -> String {
    format!("a sample of `{topic}` contradicts its type `{type_name}`: {why}")
}

/// A message of a type that is no image.
pub fn no_image_type(topic: &str, type_name: &str) -> String {
    format!("a sample of `{topic}` is no image: its type is `{type_name}`")
}

/// More objects of the host than `handles` of `[limits]` allow.
pub fn too_many_handles(allowed: u64) -> String {
    format!(
        "the lambda holds {allowed} handles; drop samples, frames, fields and topics that are not needed"
    )
}

/// An image that contradicts itself, or of which nothing can be computed.
pub fn not_a_frame(topic: &str, why: impl Display) -> String {
    format!("a sample of `{topic}` is no image that can be read: {why}")
}

/// An image that has no room in a slot for decoded ones.
pub fn too_large(topic: &str, why: impl Display) -> String {
    format!("an image of `{topic}` is too large: {why}")
}

/// Every slot for decoded images is held.
pub fn no_slot(topic: &str, input: &str) -> String {
    format!(
        "every slot for decoded images of `{topic}` is held; drop frames that are not needed, or raise `hold` of input `{input}`"
    )
}

/// Why a JPEG or PNG is too large: what it needs, and what its input's slots have.
pub fn too_many_pixels((width, height): (u32, u32), needed: u64, allowed: u64) -> String {
    let (needed, allowed) = (RoundedBytes::up(needed), RoundedBytes::down(allowed));
    format!(
        "image says it is {width}x{height} ({needed} as rgb8); this input's decoded_size is {allowed}"
    )
}
