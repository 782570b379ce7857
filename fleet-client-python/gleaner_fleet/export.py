"""Reads an export of clips: the folder that ``gleaner clips export --to DIR`` writes.

``events`` needs nothing but Python. ``messages`` needs the package ``mcap``, and ``write_parquet``
``pyarrow``; ``python -m gleaner_fleet.export DIR`` calls the latter.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, Optional, Tuple, Union

TABLE = "events.jsonl"
"""Name of the table in an export, with one object of JSON in each line."""

COLUMNS = {
    "label": "string",
    "kind": "string",
    "score": "float64",
    "attributes": "string",
    "source": "string",
    "vehicle": "string",
    "lambda": "string",
    "version": "string",
    "deployment": "string",
    "revision": "string",
    "clip": "string",
    "at_ns": "int64",
    "offset_s": "float64",
    "length_s": "float64",
    "is_complete": "bool_",
    "sha256": "string",
}
"""Columns of the table, with their types in Parquet; ``attributes`` is text there: JSON."""


def events(folder: Union[str, Path]) -> List[Dict[str, Any]]:
    """The rows of the table of an export, with the keys of ``COLUMNS``.

    Raises ValueError if a row names a clip outside the folder.
    """
    rows = []
    with (Path(folder) / TABLE).open(encoding="utf-8") as lines:
        for line in lines:
            row = {column: None for column in COLUMNS}
            row.update(json.loads(line))
            _clip(folder, row)
            rows.append(row)
    return rows


def messages(
    folder: Union[str, Path],
    event: Dict[str, Any],
    before_s: float = 1.0,
    after_s: float = 1.0,
    topics: Optional[Iterable[str]] = None,
) -> Iterator[Tuple[str, int, bytes]]:
    """Topic, time in ns and content of each message of the event's clip around the event.

    The content is CDR, which ``mcap_ros2.decoder`` and ``rosbags`` decode.
    """
    reader = importlib.import_module("mcap.reader")
    begin = int(event["at_ns"] - before_s * 1e9)
    end = int(event["at_ns"] + after_s * 1e9) + 1
    with _clip(folder, event).open("rb") as file:
        found = reader.make_reader(file).iter_messages(
            topics=None if topics is None else list(topics), start_time=begin, end_time=end
        )
        for _, channel, message in found:
            yield channel.topic, message.log_time, message.data


def write_parquet(folder: Union[str, Path]) -> Path:
    """Writes the table of an export as ``events.parquet`` beside it; returns the path."""
    arrow = importlib.import_module("pyarrow")
    parquet = importlib.import_module("pyarrow.parquet")
    rows = events(folder)
    for row in rows:
        row["attributes"] = None if row["attributes"] is None else json.dumps(row["attributes"])
    schema = arrow.schema([(name, getattr(arrow, kind)()) for name, kind in COLUMNS.items()])
    path = Path(folder) / "events.parquet"
    parquet.write_table(arrow.Table.from_pylist(rows, schema=schema), path)
    return path


def _clip(folder: Union[str, Path], event: Dict[str, Any]) -> Path:
    root = Path(folder).resolve()
    path: Path = (root / event["clip"]).resolve()
    if root not in path.parents:
        raise ValueError(f"the clip {event['clip']!r} is not in the folder {str(folder)!r}")
    return path


if __name__ == "__main__":
    print(write_parquet(sys.argv[1]))
