//! Frames of `gleaner:lambda/data` over `gleaner_host::api::frame`.

use gleaner_host::api::frame::Info;
use gleaner_pixels::{Encoding, Roi};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple};

use crate::array::{self, Frame};
use crate::data::{identity, refused, stamps};
use crate::sdk::SdkClass;

static FRAME_INFO: SdkClass = SdkClass::new("gleaner.data", "FrameInfo");

/// `x`, `y`, `width`, `height`: a `gleaner.Roi` is such a tuple.
type RoiFields = (u32, u32, u32, u32);

// Operations on pixels take up to milliseconds, in which other threads of the lambda may run.
#[pymethods]
impl Frame {
    #[getter]
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let Info { width, height, encoding, step, big_endian } = self.host().info();
        let size = self.host().bytes().len();
        FRAME_INFO.make(py, (width, height, name(encoding), step, big_endian, size))
    }

    #[getter]
    fn identity<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        identity(py, self.host().identity())
    }

    #[getter]
    fn stamps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        stamps(py, self.host().stamps())
    }

    #[pyo3(signature = (roi = None))]
    fn mean_luma(&self, py: Python<'_>, roi: Option<RoiFields>) -> PyResult<f64> {
        let roi = roi.map(region);
        py.detach(|| self.host().mean_luma(roi)).map_err(|error| refused(py, error))
    }

    #[pyo3(signature = (roi = None))]
    fn histogram<'py>(
        &self,
        py: Python<'py>,
        roi: Option<RoiFields>,
    ) -> PyResult<Bound<'py, PyArray1<u32>>> {
        let roi = roi.map(region);
        let counts =
            py.detach(|| self.host().histogram(roi)).map_err(|error| refused(py, error))?;
        Ok(PyArray1::from_slice(py, &counts))
    }

    fn resize(&self, py: Python<'_>, width: u32, height: u32) -> PyResult<Self> {
        py.detach(|| self.host().resize(width, height))
            .map(Self::new)
            .map_err(|error| refused(py, error))
    }

    fn to_gray(&self, py: Python<'_>) -> PyResult<Self> {
        py.detach(|| self.host().to_gray()).map(Self::new).map_err(|error| refused(py, error))
    }

    #[pyo3(signature = (offset = 0, len = None))]
    fn read<'py>(
        &self,
        py: Python<'py>,
        offset: u64,
        len: Option<u32>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self
            .host()
            .read(offset, len.unwrap_or(u32::MAX))
            .map_err(|error| refused(py, error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn array<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        array::over(slf)
    }

    #[pyo3(signature = (*arguments, **named))]
    fn __array__<'py>(
        slf: &Bound<'py, Self>,
        arguments: &Bound<'py, PyTuple>,
        named: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        array::over(slf)?.call_method("__array__", arguments, named)
    }

    #[pyo3(signature = (**named))]
    fn __dlpack__<'py>(
        slf: &Bound<'py, Self>,
        named: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        array::over(slf)?.call_method("__dlpack__", (), named)
    }

    fn __dlpack_device__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        array::over(slf)?.call_method0("__dlpack_device__")
    }

    fn __repr__(&self) -> String {
        let Info { width, height, encoding, .. } = self.host().info();
        format!("<Frame {}, {width}x{height} {}>", self.host().identity().topic, name(encoding))
    }
}

fn region((x, y, width, height): RoiFields) -> Roi {
    Roi { x, y, width, height }
}

/// The WIT name of an encoding, with `_` for `-`.
fn name(encoding: Encoding) -> &'static str {
    match encoding {
        Encoding::Yuv422Uyvy => "yuv422",
        Encoding::Yuv422Yuyv => "yuv422_yuy2",
        same => same.name(),
    }
}
