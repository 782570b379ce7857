//! Types, shapes and places of tensors.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Largest number of dimensions of a tensor.
pub const MAX_DIMENSIONS: usize = 8;

/// Largest size of the tensors of one call, in bytes.
pub const MAX_TENSOR_BYTES: u64 = 256 << 20;

/// Tensors in a region begin at multiples of this offset.
pub const TENSOR_ALIGNMENT: u64 = 64;

/// Type of the elements of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum Element {
    Float32,
    Float16,
    Float64,
    Int8,
    Int16,
    Int32,
    Int64,
    Uint8,
    Boolean,
}

impl Element {
    /// All of them.
    pub const ALL: [Element; 9] = [
        Element::Float32,
        Element::Float16,
        Element::Float64,
        Element::Int8,
        Element::Int16,
        Element::Int32,
        Element::Int64,
        Element::Uint8,
        Element::Boolean,
    ];

    /// Returns the size of an element in bytes.
    pub const fn size(self) -> usize {
        match self {
            Element::Int8 | Element::Uint8 | Element::Boolean => 1,
            Element::Float16 | Element::Int16 => 2,
            Element::Float32 | Element::Int32 => 4,
            Element::Float64 | Element::Int64 => 8,
        }
    }

    /// Returns the name in the WIT and in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Element::Float32 => "float32",
            Element::Float16 => "float16",
            Element::Float64 => "float64",
            Element::Int8 => "int8",
            Element::Int16 => "int16",
            Element::Int32 => "int32",
            Element::Int64 => "int64",
            Element::Uint8 => "uint8",
            Element::Boolean => "boolean",
        }
    }
}

impl fmt::Display for Element {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An input or output of a model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TensorInfo {
    /// Its name in the model.
    pub name: String,
    /// Type of its elements.
    pub element: Element,
    /// Length of each dimension; `None` for one that may have any length.
    pub shape: Vec<Option<u32>>,
}

impl TensorInfo {
    /// Returns whether a tensor of this type and shape fits.
    pub fn accepts(&self, element: Element, shape: &[u32]) -> bool {
        let fits = |(wanted, found): (&Option<u32>, &u32)| wanted.is_none_or(|it| it == *found);
        self.element == element
            && self.shape.len() == shape.len()
            && self.shape.iter().zip(shape).all(fits)
    }
}

impl fmt::Display for TensorInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} [", self.element)?;
        for (index, length) in self.shape.iter().enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            match length {
                Some(length) => write!(f, "{comma}{length}")?,
                None => write!(f, "{comma}?")?,
            }
        }
        f.write_str("]")
    }
}

/// A tensor in a region of shared memory.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TensorPlace {
    /// The name of the input or output.
    pub name: String,
    /// Type of its elements.
    pub element: Element,
    /// Length of each dimension.
    pub shape: Vec<u32>,
    /// Offset of its first byte in the region; a multiple of [`TENSOR_ALIGNMENT`].
    pub offset: u64,
}

impl TensorPlace {
    /// Returns the size of the elements in bytes; `None` if the tensor has too many dimensions, or
    /// more than [`MAX_TENSOR_BYTES`]. An output may be empty.
    pub fn bytes(&self) -> Option<u64> {
        self.element.bytes_of(&self.shape)
    }
}

impl Element {
    /// Returns the size of a tensor of `shape` in bytes, as [`TensorPlace::bytes`] does.
    pub fn bytes_of(self, shape: &[u32]) -> Option<u64> {
        if shape.len() > MAX_DIMENSIONS {
            return None;
        }
        let all = shape
            .iter()
            .try_fold(self.size() as u64, |all, length| all.checked_mul(u64::from(*length)))?;
        (all <= MAX_TENSOR_BYTES).then_some(all)
    }
}
