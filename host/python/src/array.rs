//! Exposes the pixels of a frame as a read-only numpy array without copying.
#![allow(unsafe_code)]

use std::ptr;

use gleaner_host::api::frame::Info;
use numpy::npyffi::{NpyTypes, PY_ARRAY_API, get_type_object, npy_intp};
use numpy::{PyArrayDescr, PyArrayDescrMethods, dtype};
use pyo3::exceptions::PyBufferError;
use pyo3::prelude::*;

use crate::frame::Frame;

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
    let mut layout = Layout::of(&info);
    if layout.extent > bytes.len() {
        return Err(PyBufferError::new_err("the frame has fewer bytes than its shape"));
    }
    let descr = match layout.item {
        1 => dtype::<u8>(py),
        _ => PyArrayDescr::new(py, if info.big_endian { ">u2" } else { "<u2" })?,
    };
    // SAFETY: `enter_environment` imported numpy. `dims` and `strides` have `count` entries or more
    // and are copied. All elements lie within `bytes`, as checked above, and flags of 0 forbid
    // writing. The call takes over the reference to `descr`.
    let array = unsafe {
        let array = PY_ARRAY_API.PyArray_NewFromDescr(
            py,
            get_type_object(py, NpyTypes::PyArray_Type),
            descr.into_dtype_ptr(),
            layout.count as _,
            layout.dims.as_mut_ptr(),
            layout.strides.as_mut_ptr(),
            bytes.as_ptr().cast_mut().cast(),
            0,
            ptr::null_mut(),
        );
        Bound::from_owned_ptr_or_err(py, array)?
    };
    // SAFETY: `array` has no base yet, and the call takes over a reference to `frame`. From now on
    // every view holds `frame`, which is frozen; its lease keeps `bytes` in place and writers away.
    let status = unsafe {
        PY_ARRAY_API.PyArray_SetBaseObject(
            py,
            array.as_ptr().cast(),
            frame.clone().into_any().into_ptr(),
        )
    };
    if status == 0 { Ok(array) } else { Err(PyErr::fetch(py)) }
}
