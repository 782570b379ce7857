"""The workloads of the baselines: the decision on each message, from its arrival to the labels of
the triggers. No middleware here.

The rules are those of the lambdas, imported from their files, so that lambda and baseline do the
same arithmetic. A workload reads messages by the names of their fields, which are the same in every
stack. It uses `header.stamp` where a lambda uses the time of reception: that is what a ROS node
has.

Each workload imports the libraries that it needs when it is made, and no others: their memory
counts as the node's.
"""

from __future__ import annotations

import importlib.util
import sys
from collections import deque
from itertools import islice, takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Dict, Optional, Sequence, Tuple

import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parents[3]

# A lambda imports the SDK, which needs no host and does not have to be installed.
sys.path.append(str(ROOT / "guest-sdk-python"))

from gleaner import Column  # noqa: E402

Pixels = npt.NDArray[np.uint8]

Labels = Tuple[str, ...]
"""Labels of the triggers of one wake."""

CONFIG: Dict[str, Dict[str, float]] = {
    "empty": {},
    "imu-fft": {"window_s": 1.25, "rough": 0.5},
    "imu-spectrum": {"rough": 0.09},
    "brake-dark": {"brake_mps2": -3.0, "dark_luma": 50.0},
    "yolo-detector": {"min_score": 0.4},
}
"""Workloads, and the values that each can be configured with; the defaults are the manifests'."""

WITH_IMAGES = ("brake-dark", "yolo-detector")
"""Workloads that wake on images."""

CLASSES = ("person", "bicycle")
"""Classes that `yolo-detector` reports; the default is the manifest's."""


class SettingError(ValueError):
    """A value of the command line that does not configure a workload."""


def lambda_file(folder: str) -> Any:
    """Returns the file of the Python lambda in a folder of this repository as a module."""
    path = ROOT / folder / "python" / "main.py"
    spec = importlib.util.spec_from_file_location(path.parts[-3].replace("-", "_"), path)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot import lambda `{path}`")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def stamp_ns(message: Any) -> int:
    """`header.stamp` of a message, in ns."""
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def frame(image: Any) -> Pixels:
    """Pixels of a `sensor_msgs/Image`: uint8, shape (height, width, 3), BGR. Not a copy.

    Raises ValueError for any other encoding, and for data that contradict the size."""
    if image.encoding != "bgr8":
        raise ValueError(f"an image has encoding `{image.encoding}`; send `bgr8`")
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    return rows[:, : 3 * image.width].reshape(image.height, image.width, 3)


class Ring:
    """The newest samples of one field: stamps in ns and values."""

    def __init__(self, depth: int) -> None:
        self.samples: deque[tuple[int, float]] = deque(maxlen=depth)

    def push(self, at_ns: int, value: float) -> None:
        self.samples.append((at_ns, value))

    def column(self, n: int) -> Column:
        """The `n` newest samples, oldest first; fewer if there are fewer."""
        return self._oldest_first(islice(reversed(self.samples), n))

    def column_since(self, since_ns: int) -> Column:
        """The newest samples that are all later than `since_ns`, oldest first."""
        return self._oldest_first(
            takewhile(lambda sample: sample[0] > since_ns, reversed(self.samples))
        )

    def _oldest_first(self, newest_first: Any) -> Column:
        samples = list(newest_first)[::-1]
        at_ns = np.fromiter((at for at, _ in samples), np.int64, len(samples))
        return Column(at_ns, np.fromiter((value for _, value in samples), float, len(samples)))


class Empty:
    """Wakes on each IMU sample and decides nothing."""

    def on_imu(self, imu: Any) -> Optional[Labels]:
        return ()


class ImuFft:
    """`examples/imu-fft`: wakes on each IMU sample."""

    def __init__(self, window_s: float, rough: float) -> None:
        self.road = lambda_file("examples/imu-fft").Road(window_s)
        self.rough = rough
        self.vertical = Ring(4096)

    def on_imu(self, imu: Any) -> Optional[Labels]:
        now = stamp_ns(imu)
        self.vertical.push(now, imu.linear_acceleration.z)
        n = self.road.note(now)
        if n == 0:
            return ()
        score, _peak_hz = self.road.roughness(self.vertical.column(n))
        return ("rough-road",) if score > self.rough else ()


class ImuSpectrum:
    """`bench/lambdas/imu-spectrum`: wakes on each IMU sample, with a spectrum in each wake."""

    def __init__(self, rough: float) -> None:
        rules = lambda_file("bench/lambdas/imu-spectrum")
        self.score, self.samples = rules.score, rules.SAMPLES
        self.rough = rough
        self.vertical: deque[float] = deque(maxlen=self.samples)

    def on_imu(self, imu: Any) -> Optional[Labels]:
        self.vertical.append(imu.linear_acceleration.z)
        if len(self.vertical) < self.samples:
            return ()
        score = self.score(np.fromiter(self.vertical, float, self.samples))
        return ("rough-road",) if score > self.rough else ()


class BrakeDark:
    """`examples/brake-dark`: wakes on each image, with the IMU as its second input."""

    def __init__(self, brake_mps2: float, dark_luma: float) -> None:
        import luma

        self.mean_luma = luma.mean_luma
        self.luma = luma.LIBRARY
        self.rules = lambda_file("examples/brake-dark")
        self.brake_mps2 = brake_mps2
        self.dark_luma = dark_luma
        self.forward = Ring(512)
        self.last_ns: Optional[int] = None

    def on_imu(self, imu: Any) -> Optional[Labels]:
        self.forward.push(stamp_ns(imu), imu.linear_acceleration.x)
        return None

    def on_image(self, image: Any) -> Labels:
        now = stamp_ns(image)
        window = self.forward.column_since(now - self.rules.WINDOW_NS)
        mean = self.rules.braking(window, now, self.brake_mps2)
        if mean is None or not self.rules.rested(self.last_ns, now):
            return ()
        if self.mean_luma(frame(image)) >= self.dark_luma:
            return ()
        self.last_ns = now
        return ("brake-dark",)


class YoloDetector:
    """`examples/yolo-detector`: wakes on each image, without a second input.

    Raises ImportError without ONNX Runtime or OpenCV."""

    # Defaults of a lambda: threads of one run, and of `detect`.
    THREADS, MAX_IOU, MAX_COUNT = 1, 0.45, 100

    def __init__(self, min_score: float) -> None:
        from detection import LIBRARIES, Detector

        models = ROOT / "examples" / "yolo-detector" / "python" / "models"
        self.detector = Detector(str(models / "yolox_nano.onnx"), "yolox", self.THREADS)
        self.runtime = f"{LIBRARIES}, cpu, {self.THREADS} thread"
        self.names = (models / "coco.txt").read_text("utf-8").splitlines()
        self.min_score = min_score

    def on_imu(self, imu: Any) -> Optional[Labels]:
        return None

    def on_image(self, image: Any) -> Labels:
        found = self.detector.detect(frame(image), self.min_score, self.MAX_IOU, self.MAX_COUNT)
        names = (self.names[number] for number, _score, _box in found)
        # Each class once, the one with the highest score first.
        return tuple(dict.fromkeys(name for name in names if name in CLASSES))


def workload(name: str, config: Sequence[str]) -> Any:
    """Returns the workload `name` of `CONFIG`, with KEY=VALUE of `config` in place of defaults.

    `on_imu` is called with each IMU message and `on_image`, where there is one, with each image.
    Both return the labels of the triggers; None if the message does not wake the workload.

    Raises SettingError for an unknown key, and for a value that is not a number; ImportError
    without a library of the workload."""
    values = dict(CONFIG[name])
    for entry in config:
        key, equals, number = entry.partition("=")
        if not equals or key not in values:
            keys = f"write KEY=VALUE, of {', '.join(values)}" if values else "it takes no value"
            raise SettingError(f"`{entry}` does not configure `{name}`: {keys}")
        try:
            values[key] = float(number)
        except ValueError:
            raise SettingError(f"`{number}` of `{key}` is not a number") from None
    kinds: Dict[str, Any] = {
        "empty": Empty,
        "imu-fft": ImuFft,
        "imu-spectrum": ImuSpectrum,
        "brake-dark": BrakeDark,
        "yolo-detector": YoloDetector,
    }
    return kinds[name](**values)


def probe(workload: Any) -> None:
    """Sends made-up messages to a workload, which is of no use afterwards: three seconds of an IMU
    in a car that brakes, and an image. Each workload gets as far as its last library with them.

    Raises what the workload raises."""
    on_image = getattr(workload, "on_image", None)
    for n in range(300):
        sec, hundredth = divmod(n, 100)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=hundredth * 10_000_000))
        braking = SimpleNamespace(x=-1000.0, y=0.0, z=9.81)
        workload.on_imu(SimpleNamespace(header=header, linear_acceleration=braking))
    if on_image is not None:
        width, height = 64, 48
        size = {"width": width, "height": height, "step": 3 * width}
        data = bytes(3 * width * height)
        on_image(SimpleNamespace(header=header, encoding="bgr8", data=data, **size))
