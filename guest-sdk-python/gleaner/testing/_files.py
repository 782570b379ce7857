"""Opens the files of a drive for `rosbags`, whatever else is in them: it refuses an MCAP file for
its profile, or for the schema of a topic that the caller may not want."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Any

# Magic bytes, and the opcode of a header.
BEGIN = b"\x89MCAP0\r\n\x01"
SCHEMA, FOOTER_BYTES = 0x03, 37
# Formats of schemas that `rosbags` knows.
KNOWN = (b"ros2msg", b"ros2idl", b"omgidl", b"")


class DrivePath(type(Path())):  # type: ignore[misc]
    """A path whose MCAP files have the profile `ros2`, and no schemas in formats of others.

    Source: the MCAP specification."""

    def open(self, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        file = super().open(mode, *arguments, **named)
        if mode != "rb" or file.read(len(BEGIN)) != BEGIN:
            file.seek(0)
            return file
        with file:
            # Changes stay in memory. Each record keeps its length.
            data = _Map(file.fileno(), 0, access=mmap.ACCESS_COPY)
        # The two texts of a header take at least 8 bytes, and `rosbags` reads only the first.
        data[17:25] = b"\x04\0\0\0ros2"
        end = len(data) - FOOTER_BYTES
        at = _number(data, end + 9, 8) or 17 + _number(data, 9, 8)
        while at < end:
            kind, size = struct.unpack_from("<BQ", data, at)
            if kind == SCHEMA:
                name_end = at + 15 + _number(data, at + 11, 4)
                form = data[name_end + 4 : name_end + 4 + _number(data, name_end, 4)]
                if form not in KNOWN:
                    data[name_end : at + 9 + size] = bytes(at + 9 + size - name_end)
            at += 9 + size
        return data


class _Map(mmap.mmap):
    """A file in memory. Before Python 3.13, `seek` returned nothing."""

    def seek(self, *to: Any) -> int:  # type: ignore[override]
        super().seek(*to)
        return self.tell()


def _number(data: mmap.mmap, at: int, size: int) -> int:
    return int.from_bytes(data[at : at + size], "little")
