//! Models that run in the host: `gleaner:lambda/inference`. Pixels are not copied into the lambda.
//!
//! ```
//! use gleaner_sdk::inference::{DetectOptions, Model};
//! use gleaner_sdk::{Config, Lambda, Result, Sample, event};
//!
//! struct Person {
//!     detector: Model,
//!     options: DetectOptions,
//! }
//!
//! impl Lambda for Person {
//!     fn init(_: &Config) -> Result<Self> {
//!         let options = DetectOptions { classes: vec!["person".into()], ..Default::default() };
//!         Ok(Self { detector: Model::open("detector")?, options })
//!     }
//!
//!     fn on_event(&mut self, sample: Sample) -> Result<()> {
//!         for person in self.detector.detect(&sample.as_frame()?, &self.options)? {
//!             event("person", person.score.into()).send()?;
//!         }
//!         Ok(())
//!     }
//! }
//! ```

use crate::data::{Frame, PIECE};
pub use crate::error::InferenceErrorKind;
use crate::error::{into_result, refused};
use crate::world::gleaner::lambda::inference as wit;
pub use crate::world::gleaner::lambda::inference::{
    DetectOptions, Detection, ElementType, InferenceError, TensorInfo,
};
pub use crate::world::gleaner::lambda::types::{Placement, Preprocess};
use crate::{Error, Result};

/// An array in row-major order, kept in the host. Tensors of a lambda count against `memory` in
/// `[limits]`.
pub struct Tensor(wit::Tensor);

/// A loaded `[[model]]`.
pub struct Model(wit::Model);

impl Tensor {
    /// Creates a tensor of zeros.
    ///
    /// # Errors
    ///
    /// `wrong-input` for more than 8 dimensions, a length of 0, or too many bytes.
    pub fn create(element: ElementType, shape: &[u32]) -> Result<Self> {
        Ok(Self(into_result(wit::Tensor::create(element, shape))?))
    }

    /// Creates a tensor from values in row-major order; copies them in pieces of 64 KiB.
    ///
    /// # Errors
    ///
    /// `wrong-input` unless the product of `shape` is the number of values; as [`Tensor::create`].
    pub fn from_values<T: Number>(shape: &[u32], values: &[T]) -> Result<Self> {
        let needed = shape.iter().try_fold(1_u64, |all, n| all.checked_mul(u64::from(*n)));
        if needed != Some(values.len() as u64) {
            let why = format!("a tensor of shape {shape:?} cannot have {} values", values.len());
            return Err(wrong_input(why));
        }
        let tensor = Self::create(T::ELEMENT, shape)?;
        let mut offset = 0;
        for piece in values.chunks(PIECE / size_of::<T>()) {
            tensor.write(offset, &T::to_bytes(piece))?;
            offset += size_of_val(piece) as u64;
        }
        Ok(tensor)
    }

    /// Creates a tensor from a frame, in a form of [`Preprocess`].
    ///
    /// # Errors
    ///
    /// `wrong-input` for Bayer and 16-bit encodings and for sizes out of range.
    pub fn from_frame(frame: &Frame, how: Preprocess) -> Result<Self> {
        Ok(Self(into_result(wit::Tensor::from_frame(frame.handle(), how))?))
    }

    /// Returns the type of the elements.
    pub fn element(&self) -> ElementType {
        self.0.element()
    }

    /// Returns the length of each dimension.
    pub fn shape(&self) -> Vec<u32> {
        self.0.shape()
    }

    /// Returns the size in bytes.
    pub fn size(&self) -> u64 {
        self.0.size()
    }

    /// Returns all values in row-major order; copies them in pieces of 64 KiB.
    ///
    /// # Errors
    ///
    /// `wrong-input` if the elements are not of type `T`.
    pub fn values<T: Number>(&self) -> Result<Vec<T>> {
        let element = self.element();
        if element != T::ELEMENT {
            let (wanted, found) = (element_name(T::ELEMENT), element_name(element));
            return Err(wrong_input(format!("the tensor has {found} elements, not {wanted}")));
        }
        let (mut offset, size) = (0, self.size());
        let mut values = Vec::with_capacity(size as usize / size_of::<T>());
        while offset < size {
            let piece = self.read(offset, PIECE as u32);
            values.extend(T::from_bytes(&piece));
            offset += piece.len() as u64;
        }
        Ok(values)
    }

    /// Returns bytes of the elements, little-endian: at most `len`, from `offset`, clamped to the
    /// tensor and to `call_bytes` in `[limits]`, 1 MiB by default.
    pub fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        self.0.read(offset, len)
    }

    /// Writes bytes of elements, little-endian, at `offset`. Bytes of booleans are 0 or 1.
    ///
    /// # Errors
    ///
    /// `wrong-input` if they exceed the tensor.
    pub fn write(&self, offset: u64, bytes: &[u8]) -> Result<()> {
        into_result(self.0.write(offset, bytes))
    }
}

impl Model {
    /// Opens the model `name` of the manifest, and waits until it is loaded. Do this in `init`.
    ///
    /// # Errors
    ///
    /// `no-such-model`; `failed` if the model cannot be loaded; `unavailable`; `too-slow`.
    pub fn open(name: &str) -> Result<Self> {
        Ok(Self(into_result(wit::Model::open(name))?))
    }

    /// Returns the inputs.
    pub fn inputs(&self) -> Vec<TensorInfo> {
        self.0.inputs()
    }

    /// Returns the outputs.
    pub fn outputs(&self) -> Vec<TensorInfo> {
        self.0.outputs()
    }

    /// Returns the names of the classes, from `labels` in the manifest.
    pub fn labels(&self) -> Vec<String> {
        self.0.labels()
    }

    /// Returns backend, version, provider and threads, such as `rten 0.27.0, cpu, 1 thread`.
    pub fn runtime(&self) -> String {
        self.0.runtime()
    }

    /// Runs the model once with these inputs; returns the outputs by name, in the order of
    /// [`Model::outputs`].
    ///
    /// # Errors
    ///
    /// `wrong-input` if names, shapes or types do not fit; `failed`; `unavailable`; `too-slow`.
    pub fn run(&self, inputs: &[(&str, &Tensor)]) -> Result<Vec<(String, Tensor)>> {
        let inputs: Vec<_> =
            inputs.iter().map(|(name, tensor)| ((*name).to_owned(), &tensor.0)).collect();
        let outputs = into_result(self.0.run(&inputs))?;
        Ok(outputs.into_iter().map(|(name, tensor)| (name, Tensor(tensor))).collect())
    }

    /// Finds objects in a frame; returns them by score, highest first. `layout` in the manifest
    /// determines the input and the meaning of the outputs.
    ///
    /// # Errors
    ///
    /// `wrong-input` if the model has no `layout`, for an unknown class, and for frames that
    /// [`Tensor::from_frame`] refuses; `failed`; `unavailable`; `too-slow`.
    pub fn detect(&self, frame: &Frame, options: &DetectOptions) -> Result<Vec<Detection>> {
        into_result(self.0.detect(frame.handle(), options))
    }
}

impl Default for DetectOptions {
    /// Returns the options for all classes: scores from 0.25, an overlap of at most 0.45, and at
    /// most 100 detections.
    fn default() -> Self {
        Self { classes: Vec::new(), min_score: 0.25, max_iou: 0.45, max_count: 100 }
    }
}

impl Preprocess {
    /// Returns the usual form of a tensor of this size: shape [1, 3, height, width], red first,
    /// 32-bit floats from 0 to 1, the frame in the middle with a border of grey level 114.
    ///
    /// ```
    /// use gleaner_sdk::inference::Preprocess;
    /// let how = Preprocess { bgr: true, ..Preprocess::new(640, 640) };
    /// ```
    pub fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            placement: Placement::Centre,
            fill: 114,
            bgr: false,
            channels_last: false,
            bytes: false,
            scale: 1.0 / 255.0,
            mean: (0.0, 0.0, 0.0),
            deviation: (1.0, 1.0, 1.0),
        }
    }
}

/// Returns the name of an element type in the WIT, such as `float32`.
pub fn element_name(element: ElementType) -> &'static str {
    match element {
        ElementType::Float32 => "float32",
        ElementType::Float16 => "float16",
        ElementType::Float64 => "float64",
        ElementType::Int8 => "int8",
        ElementType::Int16 => "int16",
        ElementType::Int32 => "int32",
        ElementType::Int64 => "int64",
        ElementType::Uint8 => "uint8",
        ElementType::Boolean => "boolean",
    }
}

fn wrong_input(message: String) -> Error {
    refused(InferenceError::WrongInput(message))
}

/// A Rust type of elements. Rust has none for `float16`: use [`Tensor::read`] and
/// [`Tensor::write`].
pub trait Number: Copy + sealed::LittleEndian {}

mod sealed {
    use super::ElementType;

    /// Conversion to the bytes of a tensor and back.
    pub trait LittleEndian: Sized {
        const ELEMENT: ElementType;
        fn to_bytes(values: &[Self]) -> Vec<u8>;
        fn from_bytes(bytes: &[u8]) -> impl Iterator<Item = Self>;
    }
}

macro_rules! numbers {
    ($($number:ty: $element:ident, $to:expr, $from:expr;)*) => {$(
        impl Number for $number {}

        impl sealed::LittleEndian for $number {
            const ELEMENT: ElementType = ElementType::$element;

            fn to_bytes(values: &[Self]) -> Vec<u8> {
                values.iter().flat_map(|value| $to(*value)).collect()
            }

            fn from_bytes(bytes: &[u8]) -> impl Iterator<Item = Self> {
                let (values, _) = bytes.as_chunks::<{ size_of::<$number>() }>();
                values.iter().map(|value| $from(*value))
            }
        }
    )*};
}

numbers! {
    f32: Float32, f32::to_le_bytes, f32::from_le_bytes;
    f64: Float64, f64::to_le_bytes, f64::from_le_bytes;
    i8: Int8, i8::to_le_bytes, i8::from_le_bytes;
    i16: Int16, i16::to_le_bytes, i16::from_le_bytes;
    i32: Int32, i32::to_le_bytes, i32::from_le_bytes;
    i64: Int64, i64::to_le_bytes, i64::from_le_bytes;
    u8: Uint8, u8::to_le_bytes, u8::from_le_bytes;
    bool: Boolean, |value| [u8::from(value)], |[byte]: [u8; 1]| byte != 0;
}

#[cfg(not(target_family = "wasm"))]
impl Tensor {
    pub(crate) fn from_handle(handle: wit::Tensor) -> Self {
        Self(handle)
    }

    pub(crate) fn into_handle(self) -> wit::Tensor {
        self.0
    }
}
