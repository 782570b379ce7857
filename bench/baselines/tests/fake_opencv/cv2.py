"""A fake OpenCV that cannot choose between boxes: neither `NMSBoxesBatched` nor `NMSBoxes`."""

from types import SimpleNamespace
from typing import Any

import numpy as np

__version__ = "0.fake"
INTER_LINEAR = BORDER_CONSTANT = 0


def resize(frame: Any, size: Any, interpolation: int) -> Any:
    return frame


def copyMakeBorder(frame: Any, *borders: int, value: Any) -> Any:  # noqa: N802
    return frame


dnn = SimpleNamespace(blobFromImage=lambda frame: np.zeros((1, 3, 416, 416), np.float32))
