"""The base of tests that run a lambda in the real host.

A failed assertion in a lambda is an exception, therefore a fault, and fails the test with its
traceback.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import textwrap
import unittest
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import drive
import home
from drive import Image

MANIFEST = """
[lambda]
name = "probe"
version = "0.1.0"
kind = "python"
entry = "main.py"
[schedule]
{schedule}
[[input]]
name = "camera"
topic = "/camera"
type = "sensor_msgs/msg/Image"
max_size = "1 MiB"
depth = {depth}
[config]
text = {{ default = "a" }}
number = {{ default = 1.5 }}
whole = {{ default = 2 }}
flag = {{ default = true }}
"""

EACH = 'event = "camera"\nbacklog = "each"'

GREY = Image(2, 1, "mono8", 2, b"\x07\x09")


class Hosted(unittest.TestCase):
    def setUp(self) -> None:
        self.extension = self.find_extension()
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name).resolve()

    def find_extension(self) -> str:
        """Returns the extension module; skips the test without one."""
        return home.extension_path()

    def start(
        self,
        source: str,
        images: List[Image],
        schedule: str = EACH,
        depth: int = 4,
        at_ms: Sequence[int] = range(1000, 10_000, 100),
    ) -> "subprocess.CompletedProcess[str]":
        """Replays a drive with `images`, one every 100 ms by default."""
        build = self.folder / "build"
        build.mkdir(exist_ok=True)
        (build / "main.py").write_text(textwrap.dedent(source), encoding="utf-8")
        (build / "lambda.toml").write_text(
            MANIFEST.format(schedule=schedule, depth=depth), encoding="utf-8"
        )
        self.assertLessEqual(len(images), len(at_ms))
        drive.write(self.folder / "drive.mcap", images, at_ms)
        return self.run_built()

    def run_built(self) -> "subprocess.CompletedProcess[str]":
        """Replays the drive in the folder through the build in it."""
        arguments = [
            "gleaner-runtime",
            "replay",
            str(self.folder),
            str(self.folder / "drive.mcap"),
            "--all",
        ]
        command = [
            sys.executable,
            "-I",
            "-S",
            str(home.SDK / "start.py"),
            self.extension,
            *arguments,
        ]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    def replay(
        self, source: str, images: List[Image], wakes: Optional[int] = None, **how: Any
    ) -> List[Dict[str, Any]]:
        """Returns the decision of each wake. Checks that none faulted, and that there is one for
        each image, or that there are `wakes`: assertions of a lambda only run if it is woken."""
        ended = self.start(source, images, **how)
        decisions = self.decisions()
        faults = [decision["fault"]["message"] for decision in decisions if decision["fault"]]
        self.assertEqual((ended.returncode, faults), (0, []), ended.stderr)
        self.assertEqual(len(decisions), len(images) if wakes is None else wakes)
        return decisions

    def fault(self, source: str, wake: int = 0) -> str:
        """Returns the message of the fault of a wake. There are two wakes; the replay continues
        after the first."""
        ended = self.start(source, [GREY, GREY])
        decisions = self.decisions()
        self.assertEqual((ended.returncode, len(decisions)), (6, 2), ended.stderr)
        fault: Optional[Dict[str, Any]] = decisions[wake]["fault"]
        assert fault is not None, "the wake faulted"
        self.assertEqual(fault["kind"], "exception")
        return str(fault["message"])

    def decisions(self) -> List[Dict[str, Any]]:
        return self.lines("decisions.jsonl")

    def log(self) -> List[Tuple[str, str]]:
        """Returns the level and text of each line of the log."""
        return [(line["level"], line["message"]) for line in self.lines("log.jsonl")]

    def lines(self, name: str) -> List[Dict[str, Any]]:
        path = self.folder / "out" / name
        return (
            [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            if path.exists()
            else []
        )
