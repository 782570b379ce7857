"""Tests the baselines without a middleware: workloads against their lambdas, and the programs on a
fake rclpy. `pip install ./guest-sdk-python pytest`, then `pytest bench/baselines`."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Iterator, Sequence

import numpy as np
import pytest
from gleaner.testing import replay
from PIL import Image
from rosbags.highlevel import AnyReader

BASELINES = Path(__file__).resolve().parents[1]
ROOT = BASELINES.parents[1]
EXAMPLES = ROOT / "examples"
SAMPLE = EXAMPLES / "data" / "highway_drive.mcap"
IMU, CAMERA = "/imu/data", "/camera/front/compressed"
NODE = BASELINES / "rclpy" / "node.py"
FAKE = Path(__file__).resolve().parent / "fake_ros"
FAKE_OPENCV = FAKE.with_name("fake_opencv")
FOLDERS = {
    "imu-fft": "examples/imu-fft",
    "imu-spectrum": "bench/lambdas/imu-spectrum",
    "brake-dark": "examples/brake-dark",
}

sys.path.insert(0, str(BASELINES / "lib"))

import luma  # noqa: E402
import program  # noqa: E402
import workloads  # noqa: E402


class RawImage:
    """A `sensor_msgs/Image` of a compressed one, decoded when its pixels are read."""

    encoding = "bgr8"

    def __init__(self, header: Any, jpeg: bytes) -> None:
        self.header = header
        self.picture = Image.open(io.BytesIO(jpeg))
        self.width, self.height = self.picture.size
        self.step = 3 * self.width

    @property
    def data(self) -> bytes:
        return np.asarray(self.picture.convert("RGB"))[:, :, ::-1].tobytes()


def header(at_ns: int) -> Any:
    sec, nanosec = divmod(at_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


def sample_drive() -> Iterator[tuple[str, int, Any]]:
    """Topic, time of reception and message of the sample drive; `header.stamp` is that time."""
    with AnyReader([SAMPLE]) as reader:
        chosen = [found for found in reader.connections if found.topic in (IMU, CAMERA)]
        for connection, at_ns, raw in reader.messages(chosen):
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == CAMERA:
                yield CAMERA, at_ns, RawImage(header(at_ns), bytes(message.data))
            else:
                acceleration = message.linear_acceleration
                imu = SimpleNamespace(header=header(at_ns), linear_acceleration=acceleration)
                yield IMU, at_ns, imu


@pytest.mark.parametrize(
    ("name", "config"),
    [("imu-fft", {}), ("imu-spectrum", {}), ("brake-dark", {"brake_mps2": -1.4})],
)
def test_a_workload_decides_as_its_lambda(name: str, config: dict[str, float]) -> None:
    settings = [f"{key}={value}" for key, value in config.items()]
    workload, found, begin = workloads.workload(name, settings), [], None
    for topic, at_ns, message in sample_drive():
        begin = at_ns if begin is None else begin
        decide = workload.on_imu if topic == IMU else getattr(workload, "on_image", None)
        labels = decide(message) if decide else None
        found += [(at_ns, label) for label in labels or ()]
    triggers = replay(ROOT / FOLDERS[name] / "python", SAMPLE, config=config).triggers
    assert len(triggers) >= 2
    assert [(at_ns - begin) / 1e9 for at_ns, _ in found] == pytest.approx(
        [trigger.at_s for trigger in triggers], abs=1e-6
    )
    assert [label for _, label in found] == [trigger.label for trigger in triggers]


def test_a_spectrum_is_computed_from_the_256th_message_on() -> None:
    workload = workloads.workload("imu-spectrum", [])
    up = [SimpleNamespace(linear_acceleration=SimpleNamespace(z=z)) for z in noise(0)]
    labels = [workload.on_imu(message) for message in up]
    assert labels == [()] * 255 + [("rough-road",)] * 45


def noise(seed: int, samples: int = 300) -> Any:
    return 9.81 + np.random.default_rng(seed).normal(size=samples)


def test_the_score_is_that_of_the_definition_of_the_transform() -> None:
    score = workloads.lambda_file(FOLDERS["imu-spectrum"]).score
    turn = np.arange(256) / 256
    window = np.sin(np.pi * turn) ** 2
    for seed in range(3):
        signal = noise(seed, 256)
        expected = 0.0
        # Bins are 0.390625 Hz apart.
        weighted = window * (signal - signal.mean())
        for first, end, weight in [(2, 6, 0.2), (6, 21, 0.5), (21, 52, 1.0), (52, 116, 0.5)]:
            for k in range(first, end):
                cosine = weighted @ np.cos(2 * np.pi * k * turn)
                sine = weighted @ np.sin(2 * np.pi * k * turn)
                expected += weight * 2 * (cosine**2 + sine**2) / (256 * (window @ window))
        assert score(signal) == pytest.approx(expected, rel=1e-12)
    assert score(np.full(256, 9.7)) == 0.0
    assert np.isnan(score(np.full(256, np.nan)))


def test_the_classes_of_the_detector_are_those_of_its_manifest() -> None:
    tomllib = pytest.importorskip("tomllib")
    manifest = (EXAMPLES / "yolo-detector" / "python" / "lambda.toml").read_text("utf-8")
    config = tomllib.loads(manifest)["config"]
    assert config.pop("classes")["default"].split(", ") == list(workloads.CLASSES)
    defaults = {key: entry["default"] for key, entry in config.items()}
    assert workloads.CONFIG["yolo-detector"] == defaults


@pytest.mark.parametrize("name", list(FOLDERS))
def test_the_defaults_are_those_of_the_manifest(name: str) -> None:
    tomllib = pytest.importorskip("tomllib")
    manifest = tomllib.loads((ROOT / FOLDERS[name] / "python" / "lambda.toml").read_text("utf-8"))
    defaults = {key: entry["default"] for key, entry in manifest["config"].items()}
    assert workloads.CONFIG[name] == defaults


def test_an_empty_workload_answers_without_labels() -> None:
    assert workloads.workload("empty", []).on_imu(None) == ()


def test_an_unknown_value_is_refused_with_those_that_exist() -> None:
    with pytest.raises(ValueError, match="brake_mps2, dark_luma"):
        workloads.workload("brake-dark", ["rough=1"])
    with pytest.raises(ValueError, match="`fast` of `rough` is not a number"):
        workloads.workload("imu-fft", ["rough=fast"])
    with pytest.raises(ValueError, match="no value"):
        workloads.workload("empty", ["rough=1"])


def test_the_mean_luma_leaves_out_the_padding_of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(luma, "cv2", None)
    # Two rows of one blue and one red pixel, and two bytes of padding.
    row = bytes([255, 0, 0, 0, 0, 100, 9, 9])
    image = SimpleNamespace(encoding="bgr8", width=2, height=2, step=8, data=row * 2)
    mean = luma.mean_luma(workloads.frame(image))
    assert mean == pytest.approx((0.114 * 255 + 0.299 * 100) / 2)


@pytest.mark.parametrize("name", ["empty", "imu-fft", "imu-spectrum"])
def test_a_workload_of_the_imu_does_not_import_opencv(name: str) -> None:
    code = """
        import sys, workloads
        workloads.probe(workloads.workload(sys.argv[1], []))
        assert "numpy" in sys.modules and "cv2" not in sys.modules
    """
    # The fake is found where OpenCV is not installed.
    path = os.pathsep.join(map(str, (BASELINES / "lib", FAKE_OPENCV)))
    environment = dict(os.environ, PYTHONDONTWRITEBYTECODE="1", PYTHONPATH=path)
    arguments = [sys.executable, "-c", textwrap.dedent(code), name]
    subprocess.run(arguments, env=environment, check=True, timeout=60)


def overlap(one: Any, other: Any) -> float:
    """Intersection over union of two boxes: left, top, width, height."""
    begin = np.maximum(one[:2], other[:2])
    end = np.minimum(one[:2] + one[2:], other[:2] + other[2:])
    shared = float(np.prod(np.maximum(end - begin, 0)))
    return shared / (float(np.prod(one[2:]) + np.prod(other[2:])) - shared)


def best(boxes: Any, scores: Any, min_score: float, max_iou: float, classes: Any = None) -> Any:
    """Indices of the boxes that remain, by definition; without `classes`, all are of one class. The
    result is a column, as of old versions of OpenCV."""
    boxes, kept = np.asarray(boxes), []
    for at in np.argsort(-np.asarray(scores)):
        rivals = [it for it in kept if classes is None or classes[it] == classes[at]]
        if scores[at] > min_score and all(
            overlap(boxes[at], boxes[it]) <= max_iou for it in rivals
        ):
            kept.append(int(at))
    return np.array(kept, int).reshape(-1, 1)


@pytest.mark.parametrize("library", ["OpenCV", "definition"])
@pytest.mark.parametrize("seed", range(5))
def test_boxes_are_the_same_with_every_version_of_opencv(
    library: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    dnn: Any = SimpleNamespace(NMSBoxes=best)
    if library == "OpenCV":
        dnn = pytest.importorskip("cv2").dnn
    for name in ("cv2", "onnxruntime"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__version__="none"))
    import detection

    random = np.random.default_rng(seed)
    corners, sizes = random.uniform(0, 150, (200, 2)), random.uniform(40, 150, (200, 2))
    boxes = np.concatenate((corners, sizes), 1).astype(np.float32)
    scores = random.uniform(0.3, 1, 200).astype(np.float32)
    classes = random.integers(0, 4, 200)
    expected = sorted(best(boxes, scores, 0.4, 0.45, classes).ravel())
    assert 20 < len(expected) < 120
    old = SimpleNamespace(NMSBoxes=dnn.NMSBoxes)
    for version in [old, dnn]:
        monkeypatch.setattr(detection, "cv2", SimpleNamespace(dnn=version))
        assert list(detection.suppress(boxes, scores, classes, 0.4, 0.45)) == expected
        nothing = detection.suppress(boxes[:0], scores[:0], classes[:0], 0.4, 0.45)
        assert len(nothing) == 0


def test_an_image_of_another_encoding_is_refused() -> None:
    with pytest.raises(ValueError, match="`rgb8`; send `bgr8`"):
        workloads.frame(SimpleNamespace(encoding="rgb8"))


def test_the_stand_in_decodes_pixels_into_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds")
    monkeypatch.syspath_prepend(BASELINES / "cyclonedds_py")
    import messages

    head = messages.Header(messages.Time(1, 2), "front")
    image = messages.Image(head, 2, 1, "bgr8", 0, 3, b"\0\1\2\3\4\5")
    messages.use_bytes(messages.Image, "data")
    assert messages.Image.deserialize(image.serialize()) == image


def test_a_ring_returns_its_newest_samples_oldest_first() -> None:
    ring = workloads.Ring(4)
    for at in range(6):
        ring.push(10 * at, float(at))
    assert list(ring.column(2).values) == [4.0, 5.0]
    assert list(ring.column(9).at_ns) == [20, 30, 40, 50]
    assert list(ring.column_since(30).values) == [4.0, 5.0]
    assert len(ring.column_since(50).values) == 0


def test_the_source_of_an_answer_is_that_of_a_lambda() -> None:
    tally = program.Tally("brake-dark")
    assert tally.source(()) == "brake-dark:0:"
    tally.answered = 7
    assert tally.source(("a", "b")) == "brake-dark:7:a,b"


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["brake-dark", "--input", "/a", "--answers", "/b"], "needs --image"),
        (["yolo-detector", "--input", "/a", "--answers", "/b"], "needs --image"),
        (["empty", "--input", "/a", "--answers", "/b", "--image", "/c"], "takes no --image"),
        (["empty", "--input", "a", "--answers", "/b"], "topic `a` is not absolute"),
        (["empty", "--input", "/a", "--answers", "/b", "--depth", "0"], "keeps no message"),
        (["fft", "--input", "/a", "--answers", "/b"], "brake-dark"),
    ],
)
def test_a_wrong_command_line_is_refused(
    arguments: list[str], cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        program.parse(workloads.CONFIG, workloads.WITH_IMAGES, arguments)
    assert ended.value.code == 2
    assert cause in capsys.readouterr().err


def start(*arguments: str, fakes: Sequence[Path] = (FAKE,)) -> subprocess.Popen[str]:
    """Starts the rclpy node; on `FAKE`, which sends it three messages at once."""
    environment = dict(os.environ, PYTHONDONTWRITEBYTECODE="1", ROS_DISTRO="fake")
    environment["PYTHONPATH"] = os.pathsep.join(map(str, fakes))
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, str(NODE), *arguments],
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        env=environment,
        text=True,
    )


@pytest.mark.parametrize("end", ["SIGTERM", "SIGINT", "end of standard input"])
def test_a_node_states_its_stack_answers_and_ends(end: str) -> None:
    arguments = ["--input", "/imu", "--answers", "/rtt", "--name", "bare", "--depth", "3"]
    with start("empty", *arguments) as node:
        assert node.stdout is not None and node.stdin is not None
        ready = json.loads(node.stdout.readline())
        assert ready["ready"] is True
        assert ready["stack"] == "rclpy, ROS 2 fake, rmw_fake_cpp"
        assert (ready["depth"], ready["luma"], ready["model"]) == (3, None, None)
        answers = [json.loads(node.stdout.readline()) for _ in range(3)]
        assert [answer["source"] for answer in answers] == ["bare:0:", "bare:1:", "bare:2:"]
        assert [answer["stamp"] for answer in answers] == [[0, 5], [1, 5], [2, 5]]
        assert answers[0]["time_ns"] <= answers[2]["time_ns"]
        if end.startswith("SIG"):
            node.send_signal(getattr(signal, end))
        else:
            node.stdin.close()
        last = json.loads(node.stdout.readline())
        assert (last["received"], last["answered"], last["lost"]) == (3, 3, None)
        assert last["cpu_s"] >= 0 and last["rss_kib"] > 1000
        assert node.wait(60) == 0


def test_without_rclpy_a_node_is_skipped() -> None:
    node = start("empty", "--input", "/imu", "--answers", "/rtt", fakes=())
    output, _ = node.communicate(timeout=60)
    if node.returncode == 0:
        pytest.skip("rclpy can be imported here")
    assert node.returncode == program.SKIPPED
    assert "rclpy" in json.loads(output)["skipped"]


def test_without_onnx_runtime_a_detector_is_skipped() -> None:
    arguments = ["--input", "/imu", "--image", "/camera", "--answers", "/rtt"]
    node = start("yolo-detector", *arguments)
    line = json.loads(node.stdout.readline()) if node.stdout is not None else {}
    node.communicate(timeout=60)
    if "ready" in line:
        pytest.skip("ONNX Runtime and OpenCV can be imported here")
    assert node.returncode == program.SKIPPED
    assert "cannot run workload `yolo-detector`: ModuleNotFoundError" in line["skipped"]


def test_a_workload_that_fails_is_skipped_before_the_node_is_ready() -> None:
    arguments = ["--input", "/imu", "--image", "/camera", "--answers", "/rtt"]
    node = start("yolo-detector", *arguments, fakes=(FAKE, FAKE_OPENCV))
    output, errors = node.communicate(timeout=60)
    assert (node.returncode, errors) == (program.SKIPPED, "")
    cause = "AttributeError: 'types.SimpleNamespace' object has no attribute 'NMSBoxes'"
    assert cause in json.loads(output)["skipped"]


def test_the_library_of_the_mean_luma_is_stated_with_images() -> None:
    arguments = ["--input", "/imu", "--image", "/camera", "--answers", "/rtt"]
    with start("brake-dark", *arguments) as node:
        assert node.stdout is not None and node.stdin is not None
        assert json.loads(node.stdout.readline())["luma"] == luma.LIBRARY
        node.kill()


def test_the_socket_buffer_is_the_largest_of_the_bound_sockets() -> None:
    before = program.socket_buffer()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)
        bound.bind(("127.0.0.1", 0))
        assert program.socket_buffer() == max(100_000, before or 0)
    assert program.socket_buffer() == before
