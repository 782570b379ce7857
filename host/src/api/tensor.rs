//! Tensors in the memory of the lambda's process, and frames as tensors.

use std::sync::Arc;

use gleaner_pixels::vision::{Placed, Preparer, Preprocess};
use gleaner_protocol::inference::{Element, MAX_DIMENSIONS, MAX_TENSOR_BYTES, TensorPlace};
use gleaner_rules::clamps;
use gleaner_rules::frames::{Budget, FrameLease};
use gleaner_rules::pixels::StopCheck;

use super::call::PerCall;
use super::error::DataError;
use super::frame::Frame;
use super::fuel::OutOfFuel;
use super::inference::InferenceError;
use super::models::Models;

/// Work on a prepared pixel, as the number of bytes that are copied in the same time.
const PREPARE: usize = 12;

/// An array in row-major order.
pub struct Tensor {
    content: TensorContent,
    per_call: PerCall,
    _taken: FrameLease,
}

/// The content of a tensor. Clones share its bytes, which never change while one lives.
#[derive(Clone)]
pub struct TensorContent {
    pub element: Element,
    pub shape: Vec<u32>,
    /// The elements, little-endian.
    pub bytes: Arc<Vec<u8>>,
}

/// Limits that the tensors of a lambda share: of a call, and of all tensors.
#[derive(Clone)]
pub struct TensorLimits {
    pub(super) per_call: PerCall,
    pub(super) budget: Budget,
}

impl TensorLimits {
    fn take(&self, bytes: usize) -> Result<FrameLease, InferenceError> {
        let taken = self.budget.take(bytes);
        taken.map_err(|refused| InferenceError::WrongInput(refused.to_string()))
    }

    /// Creates a tensor of `bytes`, which fit `shape`.
    pub(super) fn tensor(
        &self,
        element: Element,
        shape: Vec<u32>,
        bytes: Vec<u8>,
    ) -> Result<Tensor, InferenceError> {
        let _taken = self.take(bytes.len())?;
        let content = TensorContent { element, shape, bytes: Arc::new(bytes) };
        Ok(Tensor { content, per_call: self.per_call.clone(), _taken })
    }

    /// Creates a tensor of zeros.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] for a shape that is out of range;
    /// [`InferenceError::OutOfFuel`].
    pub fn create(&self, element: Element, shape: &[u32]) -> Result<Tensor, InferenceError> {
        let len = self.len(element, shape);
        self.per_call.charge(|| len.as_ref().map_or(0, |len| *len) + size_of_val(shape))?;
        let len = len?;
        // The budget first: memory is only taken for a tensor that fits.
        drop(self.take(len)?);
        self.tensor(element, shape.to_vec(), vec![0; len])
    }

    /// Creates a tensor of these bytes.
    ///
    /// # Errors
    ///
    /// As [`create`](Self::create), and [`InferenceError::WrongInput`] if their number does not
    /// fit.
    pub fn of_bytes(
        &self,
        element: Element,
        shape: &[u32],
        bytes: &[u8],
    ) -> Result<Tensor, InferenceError> {
        self.per_call.charge(|| bytes.len() + size_of_val(shape))?;
        let len = self.len(element, shape)?;
        if len != bytes.len() {
            let found = bytes.len();
            let message =
                format!("a tensor {element} {shape:?} has {len} bytes, and {found} are given");
            return Err(InferenceError::WrongInput(message));
        }
        drop(self.take(len)?);
        self.tensor(element, shape.to_vec(), bytes.to_vec())
    }

    /// Creates a tensor from a frame.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] for an encoding or size that cannot be converted;
    /// [`InferenceError::OutOfFuel`].
    pub fn of_frame(
        &self,
        models: &Models,
        frame: &Frame,
        how: &Preprocess,
    ) -> Result<Tensor, InferenceError> {
        self.per_call.charge(|| prepare_work(how))?;
        let (element, shape) = prepared_as(how);
        let mut bytes = Vec::new();
        models.prepare(|preparer| self.prepare(preparer, frame, how, &mut bytes))?;
        self.tensor(element, shape, bytes)
    }

    /// Converts a frame, until the call is due.
    pub(super) fn prepare(
        &self,
        preparer: &mut Preparer,
        frame: &Frame,
        how: &Preprocess,
        out: &mut Vec<u8>,
    ) -> Result<Placed, InferenceError> {
        let view = frame.whole().map_err(of_frame)?;
        let due = &self.per_call.due;
        let in_time = || due.check().is_ok();
        let size = how.size().map_err(|error| InferenceError::wrong(&error))?;
        let (element, shape) = prepared_as(how);
        // The budget first: memory is only taken for a tensor that fits.
        drop(self.take(self.len(element, &shape)?)?);
        out.resize(size, 0);
        let prepared = preparer.prepare_into(&view, how, Some(&StopCheck::new(&in_time)), out);
        prepared.map_err(|error| match due.check() {
            Err(_) => InferenceError::OutOfTime,
            Ok(()) => InferenceError::wrong(&error),
        })
    }

    fn len(&self, element: Element, shape: &[u32]) -> Result<usize, InferenceError> {
        let len = element.bytes_of(shape).filter(|len| *len > 0);
        len.and_then(|len| usize::try_from(len).ok()).ok_or_else(|| {
            let shown = &shape[..shape.len().min(MAX_DIMENSIONS + 1)];
            InferenceError::WrongInput(format!(
                "a tensor of shape {shown:?} is out of range: it has at most {MAX_DIMENSIONS} \
                 dimensions, no length of 0, and at most {MAX_TENSOR_BYTES} bytes"
            ))
        })
    }
}

/// Returns the element type and shape of a prepared frame.
pub(super) fn prepared_as(how: &Preprocess) -> (Element, Vec<u32>) {
    (if how.bytes { Element::Uint8 } else { Element::Float32 }, how.shape().to_vec())
}

pub(super) fn prepare_work(how: &Preprocess) -> usize {
    PREPARE.saturating_mul(how.width as usize).saturating_mul(how.height as usize)
}

fn of_frame(error: DataError) -> InferenceError {
    match error {
        DataError::OutOfTime => InferenceError::OutOfTime,
        DataError::OutOfFuel(error) => InferenceError::OutOfFuel(error),
        error => InferenceError::WrongInput(error.to_string()),
    }
}

impl Tensor {
    pub fn content(&self) -> &TensorContent {
        &self.content
    }

    /// Bytes from `offset`, `len` at most, clamped to the tensor and to `call_bytes` of `[limits]`.
    pub fn read(&self, offset: u64, len: u32) -> Result<&[u8], OutOfFuel> {
        let len = self.per_call.clamps().bytes.min(len as usize);
        let bytes = &self.content.bytes;
        let piece = &bytes[clamps::piece(bytes.len(), offset, len)];
        self.per_call.charge(|| piece.len())?;
        Ok(piece)
    }

    /// Writes `bytes` at `offset`.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] if they exceed the tensor; [`InferenceError::OutOfFuel`].
    pub fn write(&mut self, offset: u64, bytes: &[u8]) -> Result<(), InferenceError> {
        self.per_call.charge(|| bytes.len())?;
        let len = self.content.bytes.len();
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let end = start.checked_add(bytes.len()).filter(|end| *end <= len);
        let Some(end) = end else {
            let count = bytes.len();
            let message =
                format!("{count} bytes at {offset} exceed the tensor, which has {len} bytes");
            return Err(InferenceError::WrongInput(message));
        };
        Arc::make_mut(&mut self.content.bytes)[start..end].copy_from_slice(bytes);
        Ok(())
    }
}

impl TensorContent {
    pub(super) fn place(&self, name: &str) -> TensorPlace {
        let (name, shape) = (name.to_owned(), self.shape.clone());
        TensorPlace { name, element: self.element, shape, offset: 0 }
    }
}
