"""Runs the code of `docs/python.md` as it is printed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import home
from PIL import Image

EXAMPLES = home.CHECKOUT / "examples"


class CodeOnPage(unittest.TestCase):
    def test_the_code_on_the_page_runs_as_printed(self) -> None:
        text = (home.CHECKOUT / "docs" / "python.md").read_text(encoding="utf-8")
        blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
        self.assertGreater(len(blocks), 4)
        with tempfile.TemporaryDirectory() as name:
            for example in ("hello", "yolo-detector"):
                folder = Path(name, example)
                shutil.copytree(EXAMPLES / example / "python", folder)
                shutil.copy(EXAMPLES / "data" / "highway_drive.mcap", folder)
                for picture in ("rear.jpg", "camera.jpg"):
                    Image.new("RGB", (320, 180)).save(folder / picture)
                for number, block in enumerate(blocks):
                    if ("FakeModel" in block) == (example == "yolo-detector"):
                        (folder / f"test_{number}.py").write_text(block, encoding="utf-8")
                command = [sys.executable, "-B", "-m", "pytest", "-q", "-p", "no:cacheprovider"]
                path = {**os.environ, "PYTHONPATH": str(home.SDK)}
                done = subprocess.run(command, cwd=folder, env=path, capture_output=True, text=True)
                self.assertEqual(done.returncode, 0, done.stdout)
