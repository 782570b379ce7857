"""Tests the reader of an export of clips. Parts that need other packages are skipped without."""

from __future__ import annotations

import importlib
import json
import tempfile
import unittest
from pathlib import Path
from typing import Any, Dict

from gleaner_fleet import export


def event(clip: str, at_ns: int) -> Dict[str, Any]:
    return {
        "label": "dark",
        "kind": "event",
        "score": 0.5,
        "attributes": {"lat": 59.9},
        "vehicle": "car-7",
        "lambda": "brake",
        "clip": clip,
        "at_ns": at_ns,
        "offset_s": 5.0,
    }


class Export(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def write(self, *rows: Dict[str, Any]) -> None:
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (self.folder / export.TABLE).write_text(text, encoding="utf-8")

    def package(self, name: str) -> Any:
        """The package, which is optional; skips the test without it."""
        try:
            return importlib.import_module(name)
        except ImportError:
            self.skipTest(f"the package {name} is not installed")

    def test_each_row_has_every_column(self) -> None:
        self.write(event("car-7/a.mcap", 1), event("car-7/b.mcap", 2))
        rows = export.events(self.folder)
        self.assertEqual([row["at_ns"] for row in rows], [1, 2])
        self.assertEqual(set(rows[0]), set(export.COLUMNS))
        self.assertIsNone(rows[0]["revision"])

    def test_a_clip_outside_of_the_folder_is_refused(self) -> None:
        for clip in ("../secret", "/etc/passwd"):
            self.write(event(clip, 1))
            with self.assertRaises(ValueError):
                export.events(self.folder)

    def test_pandas_reads_the_table(self) -> None:
        pandas = self.package("pandas")
        self.package("pyarrow")
        self.write(event("car-7/a.mcap", 1), event("car-7/b.mcap", 2))
        table = pandas.read_parquet(export.write_parquet(self.folder))
        self.assertEqual(list(table.columns), list(export.COLUMNS))
        self.assertEqual(list(table["label"]), ["dark", "dark"])
        self.assertEqual(json.loads(table["attributes"][0]), {"lat": 59.9})
        self.assertEqual(list(table["at_ns"]), [1, 2])

    def test_messages_around_an_event_are_read(self) -> None:
        mcap = self.package("mcap.writer")
        path = self.folder / "car-7" / "a.mcap"
        path.parent.mkdir()
        with path.open("wb") as file:
            writer = mcap.Writer(file)
            writer.start()
            schema = writer.register_schema("x", "ros2msg", b"")
            channel = writer.register_channel("/imu", "cdr", schema)
            for second in range(10):
                time = second * 10**9
                writer.add_message(channel, time, bytes([second]), time)
            writer.finish()
        near = export.messages(self.folder, event("car-7/a.mcap", 5 * 10**9))
        self.assertEqual([data[0] for _, _, data in near], [4, 5, 6])
