"""A fake ONNX Runtime: each model is YOLOX for 416 x 416 pixels, and finds nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

__version__ = "0.fake"
SessionOptions = SimpleNamespace


class InferenceSession:
    def __init__(self, path: str, options: Any, providers: list[str]) -> None:
        pass

    def get_inputs(self) -> list[Any]:
        return [SimpleNamespace(name="images", shape=[1, 3, 416, 416])]

    def run(self, names: Any, inputs: Any) -> list[Any]:
        cells = sum((416 // stride) ** 2 for stride in (8, 16, 32))
        return [np.zeros((1, cells, 85), np.float32)]
