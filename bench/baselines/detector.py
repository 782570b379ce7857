"""Baseline without Gleaner: finds objects in frames with ONNX Runtime, numpy and OpenCV.

Arguments: model, file of frames (bgr8, one after another), layout (`ultralytics` or `yolox`), width
and height of a frame, threads, minimum score, maximum overlap, maximum number of boxes. For each
line of standard input, the number of a frame, it prints one JSON object: milliseconds from the
frame to its boxes, those of its conversion and of the session in it, and the number of boxes. The
first line names the versions, or the missing library."""
from __future__ import annotations

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent / "lib"))

try:
    import cv2
    import numpy as np
    import onnxruntime
    from detection import Detector
except ImportError as error:
    print(json.dumps({"missing": f"the Python program cannot import a library: {error}"}))
    sys.exit(0)


def main() -> None:
    path, frames, layout = sys.argv[1:4]
    width, height, threads = map(int, sys.argv[4:7])
    min_score, max_iou, max_count = float(sys.argv[7]), float(sys.argv[8]), int(sys.argv[9])
    cv2.setNumThreads(threads)
    detector = Detector(path, layout, threads)
    runtime = (
        f"Python {sys.version.split()[0]}, onnxruntime {onnxruntime.__version__}, "
        f"OpenCV {cv2.__version__}"
    )
    print(json.dumps({"runtime": runtime}), flush=True)
    frame = np.empty((height, width, 3), np.uint8)
    with open(frames, "rb") as file:
        count = file.seek(0, 2) // frame.nbytes
        for line in sys.stdin:
            file.seek(int(line) % count * frame.nbytes)
            file.readinto(frame)
            started = time.perf_counter()
            found = detector.detect(frame, min_score, max_iou, max_count)
            total_ms = 1e3 * (time.perf_counter() - started)
            times = {"prepare_ms": detector.prepare_ms, "session_ms": detector.session_ms}
            print(json.dumps({"total_ms": total_ms, **times, "boxes": len(found)}), flush=True)


main()
