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
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Iterator

import numpy as np
import pytest
from gleaner.testing import replay
from PIL import Image
from rosbags.highlevel import AnyReader

BASELINES = Path(__file__).resolve().parents[1]
EXAMPLES = BASELINES.parents[1] / "examples"
SAMPLE = EXAMPLES / "data" / "highway_drive.mcap"
IMU, CAMERA = "/imu/data", "/camera/front/compressed"
NODE = BASELINES / "rclpy" / "node.py"
FAKE = Path(__file__).resolve().parent / "fake_ros"

sys.path.insert(0, str(BASELINES / "lib"))

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
    ("name", "config"), [("imu-fft", {}), ("brake-dark", {"brake_mps2": -1.4})]
)
def test_a_workload_decides_as_its_lambda(name: str, config: dict[str, float]) -> None:
    settings = [f"{key}={value}" for key, value in config.items()]
    workload, found, begin = workloads.workload(name, settings), [], None
    for topic, at_ns, message in sample_drive():
        begin = at_ns if begin is None else begin
        decide = workload.on_imu if topic == IMU else getattr(workload, "on_image", None)
        labels = decide(message) if decide else None
        found += [(at_ns, label) for label in labels or ()]
    triggers = replay(EXAMPLES / name / "python", SAMPLE, config=config).triggers
    assert len(triggers) >= 2
    assert [(at_ns - begin) / 1e9 for at_ns, _ in found] == pytest.approx(
        [trigger.at_s for trigger in triggers], abs=1e-6
    )
    assert [label for _, label in found] == [trigger.label for trigger in triggers]


def test_the_classes_of_the_detector_are_those_of_its_manifest() -> None:
    tomllib = pytest.importorskip("tomllib")
    manifest = (EXAMPLES / "yolo-detector" / "python" / "lambda.toml").read_text("utf-8")
    config = tomllib.loads(manifest)["config"]
    assert config.pop("classes")["default"].split(", ") == list(workloads.CLASSES)
    defaults = {key: entry["default"] for key, entry in config.items()}
    assert workloads.CONFIG["yolo-detector"] == defaults


@pytest.mark.parametrize("name", ["imu-fft", "brake-dark"])
def test_the_defaults_are_those_of_the_manifest(name: str) -> None:
    tomllib = pytest.importorskip("tomllib")
    manifest = tomllib.loads((EXAMPLES / name / "python" / "lambda.toml").read_text("utf-8"))
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
    monkeypatch.setattr(workloads, "cv2", None)
    # Two rows of one blue and one red pixel, and two bytes of padding.
    row = bytes([255, 0, 0, 0, 0, 100, 9, 9])
    image = SimpleNamespace(encoding="bgr8", width=2, height=2, step=8, data=row * 2)
    luma = workloads.mean_luma(workloads.frame(image))
    assert luma == pytest.approx((0.114 * 255 + 0.299 * 100) / 2)


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


def start(*arguments: str, fake: bool = True) -> subprocess.Popen[str]:
    """Starts the rclpy node; with `fake`, on `FAKE`, which sends it three messages at once."""
    environment = dict(os.environ, PYTHONDONTWRITEBYTECODE="1", ROS_DISTRO="fake")
    environment["PYTHONPATH"] = str(FAKE) if fake else ""
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
        assert (ready["depth"], ready["luma"]) == (3, workloads.LUMA)
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
    node = start("empty", "--input", "/imu", "--answers", "/rtt", fake=False)
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
    assert "cannot import `" in line["skipped"]


def test_the_socket_buffer_is_the_largest_of_the_bound_sockets() -> None:
    before = program.socket_buffer()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)
        bound.bind(("127.0.0.1", 0))
        assert program.socket_buffer() == max(100_000, before or 0)
    assert program.socket_buffer() == before
