//! Errors of frames, tensors and outputs of models, with their messages for users.

use gleaner_rules::pixels::{Encoding, PixelError};

use crate::vision::placement::MAX_TENSOR_SIDE;

/// Dimensions of a shape that a message lists.
const LISTED_DIMENSIONS: usize = 8;

/// A frame, a tensor or an output that does not fit.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VisionError {
    #[error(
        "frame of {}: a tensor is made of rgb8, bgr8, rgba8, bgra8, mono8, uyvy or yuyv; {}",
        encoding.name(),
        way_out(*encoding)
    )]
    Encoding { encoding: Encoding },
    #[error("tensor of {width}x{height} pixels: each side must be 1 to {MAX_TENSOR_SIDE}")]
    TensorSize { width: u32, height: u32 },
    #[error("{name} of the tensor is {value}; it must be finite, and a deviation not 0")]
    Normalisation {
        /// `scale`, `mean` or `deviation`.
        name: &'static str,
        value: f32,
    },
    #[error("tensor needs {needed} bytes; the output has {found}")]
    TensorLength { needed: usize, found: usize },
    /// An operation on pixels failed, or was stopped by the caller.
    #[error(transparent)]
    Pixels(#[from] PixelError),
    #[error("layout `{name}` is not known; known are {known}")]
    UnknownLayout {
        /// The name, cut to 40 characters.
        name: String,
        known: String,
    },
    #[error(
        "layout `{layout}` needs one input [1, 3, height, width] or [1, height, width, 3]; \
         the model has {found}"
    )]
    InputShape { layout: &'static str, found: String },
    #[error(
        "layout `{layout}` needs an input of fixed size; the model has {found}: export it with a \
         fixed size, such as 640x640"
    )]
    DynamicInput { layout: &'static str, found: String },
    #[error(
        "layout `{layout}` needs one output {expected} for an input of {width}x{height}; \
         the model has {found}"
    )]
    OutputShape {
        layout: &'static str,
        expected: String,
        /// Width of the input in pixels.
        width: u32,
        /// Height of the input in pixels.
        height: u32,
        found: String,
    },
    #[error(
        "layout `{layout}` cannot decode this model, which is {kind}: call `run`, and decode its \
         output in the lambda, or use a detector of one of the families in docs/models.md"
    )]
    OtherModel { layout: &'static str, kind: String },
    #[error(
        "the model returned {value} as a score of layout `{layout}`; scores are 0 to 1: the model \
         is of another family, or its input is not as `layout` states"
    )]
    Score { layout: &'static str, value: f32 },
    #[error(
        "all boxes that the model returned end below {limit} pixels, and layout `{layout}` has \
         boxes in pixels of the input: the model is of another family, such as RT-DETR, or was \
         exported with boxes from 0 to 1"
    )]
    Normalised { layout: &'static str, limit: f32 },
    #[error("output {shape} of the model has {found} values")]
    OutputLength { shape: String, found: usize },
    #[error("class {class} is wanted; the model has classes 0 to {}", classes.saturating_sub(1))]
    Class { class: u32, classes: u32 },
    #[error("{name} is {value}; it must be 0 to 1")]
    Fraction { name: &'static str, value: f32 },
    #[error("placement of the frame in the tensor is invalid: take it from the prepared tensor")]
    Placed,
}

fn way_out(encoding: Encoding) -> &'static str {
    if encoding.is_raw() {
        "debayer it first, for example by image_proc"
    } else {
        "publish it with 8 bits, as mono8"
    }
}

/// Formats a shape, such as `[1, 84, ?]`.
pub(crate) fn shape_text(shape: impl IntoIterator<Item = Option<u32>>) -> String {
    let text_of = |length: Option<u32>| length.map_or("?".to_owned(), |it| it.to_string());
    let mut lengths = shape.into_iter().map(text_of);
    let mut listed: Vec<String> = lengths.by_ref().take(LISTED_DIMENSIONS).collect();
    listed.extend(lengths.next().map(|_| "…".to_owned()));
    format!("[{}]", listed.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shape_of_many_dimensions_is_cut() {
        assert_eq!(shape_text([Some(1), None, Some(4)]), "[1, ?, 4]");
        assert_eq!(shape_text([]), "[]");
        let text = shape_text(vec![Some(u32::MAX); 1000]);
        assert!(text.len() < 110 && text.ends_with(", …]"), "{text}");
    }
}
