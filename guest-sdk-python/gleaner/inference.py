"""Models that run on the host: interface ``inference`` of the WIT package.

This host has no model runtime yet: every call raises InferenceError (``no-runtime``).
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
    """A model that cannot be opened or run.

    ``no-runtime``: this host was built without a model runtime. ``no-such-model``: no ``[[model]]`` of that name.
    ``wrong-input``: shape, type or number of tensors does not fit the model. ``failed``: the model ran and failed.
    """

    kind: InferenceErrorKind


class Preprocess(NamedTuple):
    """How a frame becomes the input of a model."""

    width: int
    """Of the tensor, in pixels, 1 to 8,192."""
    height: int
    """Of the tensor, in pixels, 1 to 8,192."""
    letterbox: bool = True
    """Keep the aspect ratio and fill the rest with ``fill``; otherwise stretch."""
    fill: int = 114
    """Grey level 0 to 255 of the filled border."""
    bgr: bool = False
    """Channel order of the tensor: blue first if true, else red first."""
    mean: Tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Each channel becomes ``(value - mean) * scale``, with ``value`` from 0 to 255."""
    scale: Tuple[float, float, float] = (1 / 255, 1 / 255, 1 / 255)


class Detection(NamedTuple):
    """What ``detect`` found, in pixels of the frame."""

    class_: int
    """The WIT's ``class``, which is a keyword of Python."""
    score: float
    """0 to 1."""
    x: float
    y: float
    width: float
    height: float


class DetectOptions(NamedTuple):
    """What ``detect`` looks for."""

    classes: Sequence[int] = ()
    """Classes wanted; empty for all."""
    min_score: float = 0.25
    """Detections below are dropped, 0 to 1."""
    max_iou: float = 0.45
    """Overlap (intersection over union) above which the weaker of two detections is dropped, 0 to 1."""
    max_count: int = 100
    """At most so many, strongest first; clamped to 1,024."""


class Tensor(Protocol):
    """Numbers in row-major order, on the host."""

    @staticmethod
    def from_values(
        shape: Sequence[int], values: Sequence[float] | npt.NDArray[np.float32]
    ) -> Tensor:
        """Makes a tensor of 32-bit floats.

        Raises InferenceError: ``wrong-input`` unless the product of ``shape`` is the number of ``values``."""
        tensor: Tensor = _hosted().Tensor.from_values(shape, values)
        return tensor

    @staticmethod
    def from_frame(frame: Frame, how: Preprocess) -> Tensor:
        """Makes a tensor of shape (1, 3, height, width) from a frame."""
        tensor: Tensor = _hosted().Tensor.from_frame(frame, how)
        return tensor

    @property
    def shape(self) -> list[int]:
        """Its dimensions."""

    def read(self, offset: int = 0, len: int | None = None) -> npt.NDArray[np.float32]:
        """Values from ``offset``, ``len`` at most; clamped to the tensor and to 262,144 values."""


class Model(Protocol):
    """A loaded ``[[model]]``."""

    @staticmethod
    def open(name: str) -> Model:
        """Opens the model of that name. Do this in ``__init__``.

        Raises InferenceError: ``no-such-model``."""
        model: Model = _hosted().Model.open(name)
        return model

    def run(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Runs the model once.

        Raises InferenceError: ``wrong-input``; ``failed``."""

    def detect(self, frame: Frame, options: DetectOptions = DetectOptions()) -> list[Detection]:
        """Objects in a frame, strongest first.

        Raises InferenceError: ``wrong-input`` if the model is no detector; ``failed``."""


def _hosted() -> Any:
    try:
        return importlib.import_module("_gleaner")
    except ImportError:
        raise InferenceError(
            "models run on a Gleaner host, and this is none", "no-runtime"
        ) from None
