"""Models that run in the host: interface ``inference`` of the WIT package.

No current host has a model runtime: every call raises InferenceError (``no-runtime``).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, Sequence, Tuple

from .error import Error

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from .data import Frame

InferenceErrorKind = Literal["no-runtime", "no-such-model", "wrong-input", "failed"]


class InferenceError(Error):
    """An error in opening or running a model.

    ``no-runtime``: this host was built without a model runtime. ``no-such-model``: the manifest has
    no ``[[model]]`` of that name. ``wrong-input``: shapes, types or number of the tensors do not
    fit the model. ``failed``: the model failed to load or to run.
    """

    kind: InferenceErrorKind


class Preprocess(NamedTuple):
    """Conversion of a frame to the input tensor of a model."""

    width: int
    """Width of the tensor in pixels, 1 to 8,192."""
    height: int
    """Height of the tensor in pixels, 1 to 8,192."""
    letterbox: bool = True
    """True to keep the aspect ratio and fill the rest with ``fill``; false to stretch."""
    fill: int = 114
    """Grey level of the filled border, 0 to 255."""
    bgr: bool = False
    """Channel order of the tensor: true for blue first, false for red first."""
    mean: Tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Each channel becomes ``(value - mean) * scale``, with ``value`` from 0 to 255."""
    scale: Tuple[float, float, float] = (1 / 255, 1 / 255, 1 / 255)


class Detection(NamedTuple):
    """An object that ``detect`` found; its box is in pixels of the frame."""

    class_: int
    """Class index of the model. It is ``class`` in the WIT, which is a keyword of Python."""
    score: float
    """Confidence, 0 to 1."""
    x: float
    """Left edge."""
    y: float
    """Upper edge."""
    width: float
    """Width, above 0."""
    height: float
    """Height, above 0."""


class DetectOptions(NamedTuple):
    """Options of ``detect``."""

    classes: Sequence[int] = ()
    """Classes to return; empty for all."""
    min_score: float = 0.25
    """Minimum score, 0 to 1; detections with a lower one are dropped."""
    max_iou: float = 0.45
    """Overlap (intersection over union), 0 to 1, above which the detection with the lower score is
    dropped."""
    max_count: int = 100
    """Maximum number of detections, highest score first; clamped to 1,024."""


class Tensor(Protocol):
    """An array of numbers in row-major order, kept in the host."""

    @staticmethod
    def from_values(
        shape: Sequence[int], values: Sequence[float] | npt.NDArray[np.float32]
    ) -> Tensor:
        """Creates a tensor of 32-bit floats.

        Raises InferenceError: ``wrong-input`` unless the product of ``shape`` is the length of
        ``values``; ``no-runtime``."""
        tensor: Tensor = _hosted().Tensor.from_values(shape, values)
        return tensor

    @staticmethod
    def from_frame(frame: Frame, how: Preprocess) -> Tensor:
        """Creates a tensor of shape (1, 3, height, width) from a frame.

        Raises InferenceError: ``wrong-input`` for Bayer encodings and sizes out of range;
        ``no-runtime``."""
        tensor: Tensor = _hosted().Tensor.from_frame(frame, how)
        return tensor

    @property
    def shape(self) -> list[int]:
        """Length of each dimension."""

    def read(self, offset: int = 0, len: int | None = None) -> npt.NDArray[np.float32]:
        """Returns values: at most ``len``, from ``offset``, clamped to the tensor and to 262,144
        values."""


class Model(Protocol):
    """A loaded ``[[model]]``."""

    @staticmethod
    def open(name: str) -> Model:
        """Opens the model ``name`` of the manifest. Do this in ``__init__``.

        Raises InferenceError: ``no-such-model``; ``failed`` if the model cannot be loaded;
        ``no-runtime``."""
        model: Model = _hosted().Model.open(name)
        return model

    def run(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Runs the model once.

        Raises InferenceError: ``wrong-input`` if the number, shapes or types of ``inputs`` do not
        fit; ``failed``."""

    def detect(self, frame: Frame, options: DetectOptions = DetectOptions()) -> list[Detection]:
        """Finds objects in a frame; returns them by score, highest first.

        Raises InferenceError: ``wrong-input`` if the model is not a detector; ``failed``."""


def _hosted() -> Any:
    try:
        return importlib.import_module("_gleaner")
    except ImportError:
        raise InferenceError("models run only in a Gleaner host", "no-runtime") from None
