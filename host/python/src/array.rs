//! Exposes the pixels of a frame, and tensors, as read-only numpy arrays without copying. The
//! classes of the objects that hold their memory are here.
#![allow(unsafe_code)]

use std::ptr;

use gleaner_host::api::frame::{self, Info};
use gleaner_host::api::inference::TensorContent;
use gleaner_protocol::inference::Element;
use numpy::npyffi::{NpyTypes, PY_ARRAY_API, get_type_object, npy_intp};
use numpy::{PyArrayDescr, PyArrayDescrMethods, dtype};
use pyo3::exceptions::PyBufferError;
use pyo3::prelude::*;

/// A sample seen as an image. Never give out `&mut` to its content: arrays over its pixels rely on
/// that.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Frame(frame::Frame);

impl Frame {
    pub(crate) fn new(inner: frame::Frame) -> Self {
        Self(inner)
    }

    pub(crate) fn host(&self) -> &frame::Frame {
        &self.0
    }
}

/// The bytes of a tensor, which the arrays over them hold. Never give out `&mut` to its content:
/// those arrays rely on that.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct TensorBytes(pub(crate) TensorContent);

/// Memory layout of an array over a frame.
struct Layout {
    dims: [npy_intp; 3],
    /// In bytes, one for each dimension.
    strides: [npy_intp; 3],
    /// Dimensions in use: 3 with channels, 2 without.
    count: usize,
    /// Bytes of an element.
    item: usize,
    /// Bytes from the first element to the end of the last.
    extent: usize,
}

impl Layout {
    /// Shape (height, width, channels), or (height, width) for one channel; strides skip the
    /// padding after each row.
    fn of(info: &Info) -> Self {
        let (width, height, step) = (info.width as usize, info.height as usize, info.step as usize);
        let (pixel, channels) = (info.encoding.bytes_per_pixel(), info.encoding.channels());
        let item = pixel / channels;
        // Sides have at most 16 bits and a step has 32, so every product below fits into 64 bits.
        Self {
            dims: [height, width, channels].map(|n| n as npy_intp),
            strides: [step, pixel, item].map(|n| n as npy_intp),
            count: if channels == 1 { 2 } else { 3 },
            item,
            extent: step * height.saturating_sub(1) + width * pixel,
        }
    }
}

/// A read-only array over the pixels of `frame`. It holds the frame, and with it the slot, until
/// the last view is dropped.
pub(crate) fn over<'py>(frame: &Bound<'py, Frame>) -> PyResult<Bound<'py, PyAny>> {
    let py = frame.py();
    let host = frame.get().host();
    let (info, bytes) = (host.info(), host.bytes());
    let layout = Layout::of(&info);
    if layout.extent > bytes.len() {
        return Err(PyBufferError::new_err("the frame has fewer bytes than its shape"));
    }
    let descr = match layout.item {
        1 => dtype::<u8>(py),
        _ => PyArrayDescr::new(py, if info.big_endian { ">u2" } else { "<u2" })?,
    };
    let (mut dims, mut strides) = (layout.dims, layout.strides);
    // SAFETY: all elements of this layout lie within `bytes`, as checked above. `frame` is frozen,
    // and its lease keeps `bytes` in place and writers away.
    unsafe {
        lend(frame.as_any(), bytes, descr, &mut dims[..layout.count], &mut strides[..layout.count])
    }
}

/// A read-only array over the elements of a tensor. It holds the tensor's bytes until the last view
/// is dropped.
pub(crate) fn over_tensor<'py>(tensor: &Bound<'py, TensorBytes>) -> PyResult<Bound<'py, PyAny>> {
    let TensorContent { element, shape, bytes } = &tensor.get().0;
    if element.bytes_of(shape) != Some(bytes.len() as u64) {
        return Err(PyBufferError::new_err("the tensor has fewer bytes than its shape"));
    }
    let code = match element {
        Element::Float32 => "<f4",
        Element::Float16 => "<f2",
        Element::Float64 => "<f8",
        Element::Int8 => "i1",
        Element::Int16 => "<i2",
        Element::Int32 => "<i4",
        Element::Int64 => "<i8",
        Element::Uint8 => "u1",
        Element::Boolean => "?",
    };
    let descr = PyArrayDescr::new(tensor.py(), code)?;
    let mut dims: Vec<_> = shape.iter().map(|length| *length as npy_intp).collect();
    let mut strides = vec![element.size() as npy_intp; dims.len()];
    for index in (1..dims.len()).rev() {
        // The product of all lengths fits, as checked above, unless one of them is 0.
        strides[index - 1] = if bytes.is_empty() { 0 } else { strides[index] * dims[index] };
    }
    // SAFETY: all elements of this shape, in row-major order, lie within `bytes`, as checked above.
    // `tensor` is frozen, and the bytes that it shares are never changed while it lives.
    unsafe { lend(tensor.as_any(), bytes, descr, &mut dims, &mut strides) }
}

/// A read-only array over `bytes`, which `owner` holds.
///
/// # Safety
///
/// All elements that `descr`, `dims` and `strides` describe lie within `bytes`. These stay in
/// place, unchanged, while `owner` lives.
unsafe fn lend<'py>(
    owner: &Bound<'py, PyAny>,
    bytes: &[u8],
    descr: Bound<'py, PyArrayDescr>,
    dims: &mut [npy_intp],
    strides: &mut [npy_intp],
) -> PyResult<Bound<'py, PyAny>> {
    let py = owner.py();
    // SAFETY: `enter_environment` imported numpy. `dims` and `strides` have one entry for each
    // dimension and are copied. Flags of 0 forbid writing. The call takes over the reference to
    // `descr`.
    let array = unsafe {
        let array = PY_ARRAY_API.PyArray_NewFromDescr(
            py,
            get_type_object(py, NpyTypes::PyArray_Type),
            descr.into_dtype_ptr(),
            dims.len() as _,
            dims.as_mut_ptr(),
            strides.as_mut_ptr(),
            bytes.as_ptr().cast_mut().cast(),
            0,
            ptr::null_mut(),
        );
        Bound::from_owned_ptr_or_err(py, array)?
    };
    // SAFETY: `array` has no base yet, and the call takes over a reference to `owner`. From now on
    // every view holds `owner`, and with it `bytes`.
    let status = unsafe {
        PY_ARRAY_API.PyArray_SetBaseObject(py, array.as_ptr().cast(), owner.clone().into_ptr())
    };
    if status == 0 { Ok(array) } else { Err(PyErr::fetch(py)) }
}
