"""A detector in plain Python: ONNX Runtime, numpy and OpenCV."""

from __future__ import annotations

import time

import cv2
import numpy as np
import onnxruntime

BORDER = (114, 114, 114)

LIBRARIES = f"onnxruntime {onnxruntime.__version__}, OpenCV {cv2.__version__}"
"""Libraries that detect, with their versions."""


class Detector:
    """A model with its input and output of one layout."""

    def __init__(self, path: str, layout: str, threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            path, options, providers=["CPUExecutionProvider"]
        )
        self.layout = layout
        self.name = self.session.get_inputs()[0].name
        self.height, self.width = self.session.get_inputs()[0].shape[2:]
        self.prepare_ms = self.session_ms = 0.0
        if layout == "yolox":
            self.grids, self.strides = self.cells()

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the cells of YOLOX, and their strides."""
        grids, strides = [], []
        for stride in (8, 16, 32):
            x, y = np.meshgrid(np.arange(self.width // stride), np.arange(self.height // stride))
            grids.append(np.stack((x, y), 2).reshape(-1, 2))
            strides.append(np.full((grids[-1].shape[0], 1), stride))
        return np.concatenate(grids), np.concatenate(strides)

    def letterbox(self, frame: np.ndarray) -> tuple[np.ndarray, float, int, int]:
        height, width = frame.shape[:2]
        ratio = min(self.height / height, self.width / width)
        if self.layout == "yolox":
            wide, high, left, top = int(width * ratio), int(height * ratio), 0, 0
        else:
            wide, high = round(width * ratio), round(height * ratio)
            left, top = (self.width - wide) // 2, (self.height - high) // 2
        resized = cv2.resize(frame, (wide, high), interpolation=cv2.INTER_LINEAR)
        right, bottom = self.width - wide - left, self.height - high - top
        padded = cv2.copyMakeBorder(
            resized, top, bottom, left, right, cv2.BORDER_CONSTANT, value=BORDER
        )
        if self.layout == "yolox":
            blob = cv2.dnn.blobFromImage(padded)
        else:
            blob = cv2.dnn.blobFromImage(padded, 1 / 255, swapRB=True)
        return blob, ratio, left, top

    def decode(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Boxes by centre and size in pixels of the input, scores and classes."""
        if self.layout == "yolox":
            rows = output[0]
            scores = rows[:, 5:] * rows[:, 4:5]
            classes = scores.argmax(1)
            centres = (rows[:, :2] + self.grids) * self.strides
            sizes = np.exp(rows[:, 2:4]) * self.strides
            return np.concatenate((centres, sizes), 1), scores.max(1), classes
        scores = output[0, 4:]
        return output[0, :4].T, scores.max(0), scores.argmax(0)

    def detect(
        self, frame: np.ndarray, min_score: float, max_iou: float, max_count: int
    ) -> list[tuple[int, float, np.ndarray]]:
        began = time.perf_counter()
        blob, ratio, left, top = self.letterbox(frame)
        started = time.perf_counter()
        self.prepare_ms = 1e3 * (started - began)
        (output,) = self.session.run(None, {self.name: blob})
        self.session_ms = 1e3 * (time.perf_counter() - started)
        boxes, scores, classes = self.decode(output)
        good = scores >= min_score
        boxes, scores, classes = boxes[good], scores[good], classes[good]
        boxes[:, :2] -= boxes[:, 2:] / 2
        # Only those with an area in the frame.
        height, width = frame.shape[:2]
        start = np.clip((boxes[:, :2] - (left, top)) / ratio, 0, (width, height))
        end = np.clip((boxes[:, :2] + boxes[:, 2:] - (left, top)) / ratio, 0, (width, height))
        inside = (end > start).all(1)
        boxes, scores, classes = boxes[inside], scores[inside], classes[inside]
        found = np.concatenate((start, end - start), 1)[inside]
        kept = suppress(boxes, scores, classes, min_score, max_iou)
        kept = kept[np.argsort(-scores[kept], kind="stable")][:max_count]
        return [(int(classes[at]), float(scores[at]), found[at]) for at in kept]


def suppress(
    boxes: np.ndarray, scores: np.ndarray, classes: np.ndarray, min_score: float, max_iou: float
) -> np.ndarray:
    """Returns the indices, in rising order, of the boxes that overlap no better box of their class
    by more than `max_iou`.

    OpenCV handles all classes in one call since 4.7. Before, it takes a call for each class, and
    only lists of floats in every version."""
    if hasattr(cv2.dnn, "NMSBoxesBatched"):
        kept = cv2.dnn.NMSBoxesBatched(boxes, scores, classes, min_score, max_iou)
        return np.sort(np.asarray(kept, int).reshape(-1))
    of_one_class = cv2.dnn.NMSBoxes
    found = [np.empty(0, int)]
    for number in np.unique(classes):
        (members,) = np.nonzero(classes == number)
        kept = of_one_class(boxes[members].tolist(), scores[members].tolist(), min_score, max_iou)
        found.append(members[np.asarray(kept, int).reshape(-1)])
    return np.sort(np.concatenate(found))
