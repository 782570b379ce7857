"""Compares a local replay with the real host: the same lambda decides the same on the same drive,
to the last bit of its scores."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from typing import Any, Dict, List, Union

import home
from local_run import LocalRun
from drive import Image
from hosted import Hosted

from gleaner.testing import Run, replay

SAMPLE = home.CHECKOUT / "examples" / "data" / "highway_drive.mcap"

# The run time differs each time.
NOT_COMPARED = ("run_ns",)


def comparable(decision: Dict[str, Any]) -> Dict[str, Any]:
    return {key: value for key, value in decision.items() if key not in NOT_COMPARED}


class Examples(unittest.TestCase):
    """Examples on the sample drive. Their `expected.txt` has the results."""

    def example(self, name: str, config: Dict[str, Union[int, float]]) -> Run:
        return self.both(home.CHECKOUT / "examples" / name / "python", config)

    def both(self, python: Path, config: Dict[str, Union[int, float]]) -> Run:
        """Replays in the host and locally, and compares the decisions."""
        extension = home.extension_path()
        with tempfile.TemporaryDirectory() as folder:
            shutil.copytree(
                python,
                Path(folder) / "build",
                ignore=shutil.ignore_patterns("build", "out", "__pycache__"),
            )
            command = [
                sys.executable,
                "-I",
                str(home.SDK / "start.py"),
                extension,
                "gleaner-runtime",
                "replay",
                folder,
            ]
            for key, value in config.items():
                command += ["--set", f"{key}={value}"]
            ended = subprocess.run(
                [*command, str(SAMPLE), "--all"], capture_output=True, text=True, timeout=300
            )
            self.assertEqual(ended.returncode, 0, ended.stderr)
            out = Path(folder) / "out"
            lines = (out / "decisions.jsonl").read_text(encoding="utf-8").splitlines()
            clips = [
                json.loads(clip)
                for clip in (out / "clips.jsonl").read_text(encoding="utf-8").splitlines()
            ]
        run = replay(python, SAMPLE, config=config)
        decided = [decision.as_json() for decision in run.decisions]
        self.assertEqual(len(decided), len(lines))
        for n, (local, hosted) in enumerate(zip(decided, map(json.loads, lines))):
            self.equal(local, hosted, f"decision {n}")
        kept = [(clip["from_ns"], clip["to_ns"]) for clip in clips]
        self.assertEqual([(window.from_ns, window.to_ns) for window in run.windows], kept)
        return run

    def equal(self, local: Dict[str, Any], hosted: Dict[str, Any], which: str) -> None:
        self.assertEqual(comparable(local), comparable(hosted), which)

    def test_hello(self) -> None:
        run = self.example("hello", {"brake_mps2": -1.4})
        self.assertEqual(
            [(round(t.at_s, 2), t.label) for t in run.triggers],
            [(at, "hard-brake") for at in (4.14, 10.8, 38.22)],
        )

    def test_imu_fft(self) -> None:
        run = self.example("imu-fft", {"rough": 0.02})
        self.assertGreater(len(run.triggers), 50)

    def test_recorded_topics_do_not_change_the_ticks(self) -> None:
        ticks = []
        with tempfile.TemporaryDirectory() as folder:
            for recorded in (
                'topics = ["/imu/data"]',
                'topics = ["/camera/front/compressed", "/imu/data"]',
            ):
                (Path(folder) / "main.py").write_text(TICKS, encoding="utf-8")
                (Path(folder) / "lambda.toml").write_text(PERIODIC + recorded, encoding="utf-8")
                run = self.both(Path(folder), {})
                ticks.append([decision.at_ns for decision in run.decisions])
        # The camera begins before the IMU.
        self.assertEqual(ticks[0], ticks[1])
        self.assertEqual(len(ticks[0]), 399)


PERIODIC = """
[lambda]
name = "ticks"
version = "0.1.0"
kind = "python"
entry = "main.py"
[schedule]
period = "100ms"
[[input]]
name = "imu"
topic = "/imu/data"
type = "sensor_msgs/msg/Imu"
[record]
postroll = "10ms"
preroll = "10ms"
"""

TICKS = """
def on_tick(ctx):
    newest = ctx.input("imu").newest()
    age = ctx.now_ns() - newest.stamps.at_ns
    ctx.event("tick", newest.number("linear_acceleration.z"), seq=newest.identity.seq, age=age)
"""


class Pictures(Examples):
    """The local JPEG decoder is another one; its pixels differ by at most 3 of 255 on this
    drive."""

    def equal(self, local: Dict[str, Any], hosted: Dict[str, Any], which: str) -> None:
        lumas = [
            [trigger["attributes"].pop("luma") for trigger in it["triggers"]]
            for it in (local, hosted)
        ]
        super().equal(local, hosted, which)
        for luma, expected in zip(*lumas):
            self.assertAlmostEqual(luma, expected, delta=0.01)

    test_hello = test_imu_fft = None  # type: ignore[assignment]
    test_recorded_topics_do_not_change_the_ticks = None  # type: ignore[assignment]

    def test_brake_dark(self) -> None:
        run = self.example("brake-dark", {"brake_mps2": -1.4, "dark_luma": 50})
        self.assertEqual(
            [(round(t.at_s, 1), t.label) for t in run.triggers],
            [(11.0, "brake-dark"), (38.3, "brake-dark")],
        )


# Sums of pixels of every layout as attributes, and checksums of the frames that were created.
PIXELS = """
import zlib

ROIS = [None, (1, 1, 3, 2), (2, 0, 9, 9)]
SIZES = [(1, 1), (3, 2), (5, 4), (7, 3), (8, 6), (16, 5), (20, 17)]

def on_event(ctx, event):
    frame = event.as_frame()
    ctx.event("info", 0.0, **frame.info._asdict())
    array = frame.array()
    ctx.event("array", 0.0, shape=str(array.shape), pixels=zlib.crc32(array.tobytes()))
    ctx.event("read", 0.0, pixels=zlib.crc32(frame.read()), piece=zlib.crc32(frame.read(3, 5)))
    try:
        for roi in ROIS:
            histogram = zlib.crc32(frame.histogram(roi).tobytes())
            ctx.event("luma", frame.mean_luma(roi), histogram=histogram)
        ctx.event("gray", 0.0, pixels=zlib.crc32(frame.to_gray().read()))
        for width, height in SIZES:
            made = frame.resize(width, height)
            ctx.event("resize", 0.0, encoding=made.info.encoding, pixels=zlib.crc32(made.read()))
    except ValueError as error:
        ctx.event("refused", 0.0, why=str(error), kind=error.kind)
"""


class Operations(unittest.TestCase):
    def test_operations_on_raw_frames_are_equal_to_the_last_bit(self) -> None:
        home.extension_path()
        images = pictures()
        found = []
        for how in (Hosted, LocalRun):
            case = how()
            case.setUp()
            self.addCleanup(case.doCleanups)
            decisions = case.replay(PIXELS, images)
            found.append([decision["triggers"] for decision in decisions])
        labels = [trigger["label"] for triggers in found[0] for trigger in triggers]
        self.assertEqual((labels.count("resize"), labels.count("refused")), (7 * 8, 3))
        for image, hosted, local in zip(images, *found):
            self.assertEqual(local, hosted, image.encoding)


def pictures() -> List[Image]:
    """Returns an image of each layout, with random pixels, with and without padding of rows."""
    noise = random.Random(6)
    images = []
    for encoding, pixel in [
        *[("rgb8", 3), ("bgr8", 3), ("rgba8", 4), ("bgra8", 4), ("mono8", 1), ("8UC3", 3)],
        *[("yuv422", 2), ("yuyv", 2), ("bayer_rggb8", 1), ("bayer_gbrg16", 2)],
    ]:
        step = 8 * pixel + noise.choice([0, 5])
        images.append(Image(8, 6, encoding, step, noise.randbytes(step * 6)))
    images.append(Image(8, 6, "mono16", 16, noise.randbytes(96), big_endian=True))
    return images
