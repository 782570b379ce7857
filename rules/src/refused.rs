//! Error texts of refused reads, for the lambda's author. The errors of the other modules have
//! their own texts.

use std::fmt::Display;

use crate::text::{RoundedBytes, quoted};

pub fn no_such_input<S: AsRef<str>>(name: &str, known: impl IntoIterator<Item = S>) -> String {
    let name = name.chars().take(64).collect::<String>();
    format!("no input `{name}`; the manifest has {}", quoted(known))
}

pub fn no_such_model<S: AsRef<str>>(name: &str, known: impl IntoIterator<Item = S>) -> String {
    let (name, known) = (name.chars().take(64).collect::<String>(), quoted(known));
    let way_out = if known == "none" { "; add a [[model]] of this name" } else { "" };
    format!("no model `{name}`; the manifest has {known}{way_out}")
}

/// Returns the text for a message whose bytes do not match its type.
pub fn malformed(topic: &str, type_name: &str, why: impl Display) -> String {
    format!("a sample of `{topic}` contradicts its type `{type_name}`: {why}")
}

pub fn no_image_type(topic: &str, type_name: &str) -> String {
    format!("a sample of `{topic}` is not an image: its type is `{type_name}`")
}

/// Returns the text for too many handles, by `handles` of `[limits]`.
pub fn too_many_handles(allowed: u64) -> String {
    format!(
        "the lambda holds {allowed} handles; \
         drop samples, frames, fields and topics that are not needed"
    )
}

/// Returns the text for an invalid image, or one that cannot be decoded.
pub fn not_a_frame(topic: &str, why: impl Display) -> String {
    format!("a sample of `{topic}` is not a readable image: {why}")
}

/// Returns the text for an image that is too large for a slot.
pub fn too_large(topic: &str, why: impl Display) -> String {
    format!("an image of `{topic}` is too large: {why}")
}

/// Returns the text for an image without a free slot.
pub fn no_slot(topic: &str, input: &str) -> String {
    format!(
        "every slot for decoded images of `{topic}` is held; \
         drop frames that are not needed, or raise `hold` of input `{input}`"
    )
}

/// Returns the reason why a JPEG or PNG is too large: the needed size, and that of its input's
/// slots.
pub fn too_many_pixels((width, height): (u32, u32), needed: u64, allowed: u64) -> String {
    let (needed, allowed) = (RoundedBytes::up(needed), RoundedBytes::down(allowed));
    format!(
        "image has a size of {width}x{height} ({needed} as rgb8); \
         this input's decoded_size is {allowed}"
    )
}
