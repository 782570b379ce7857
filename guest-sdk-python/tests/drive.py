"""Writes small drives for the tests: MCAP files with `sensor_msgs/msg/Image`, without chunks and
summary.

Source: the MCAP specification, and OMG CDR in its little-endian form (all fields aligned to their
size).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import List, Sequence

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, DATA_END = 0x01, 0x02, 0x03, 0x04, 0x05, 0x0F
TOPIC = "/camera"

DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


@dataclass
class Image:
    """One image; `data` has `step` bytes for each row."""

    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    big_endian: bool = False
    frame_id: str = "cam"

    def cdr(self) -> bytes:
        cdr = _Cdr()
        cdr.number("i", 7)
        cdr.number("I", 500)
        cdr.text(self.frame_id)
        cdr.number("I", self.height)
        cdr.number("I", self.width)
        cdr.text(self.encoding)
        cdr.number("B", self.big_endian)
        cdr.number("I", self.step)
        cdr.number("I", len(self.data))
        return b"\x00\x01\x00\x00" + bytes(cdr.bytes) + self.data


class _Cdr:
    def __init__(self) -> None:
        self.bytes = bytearray()

    def number(self, kind: str, value: int) -> None:
        self.bytes += bytes(-len(self.bytes) % struct.calcsize(kind))
        self.bytes += struct.pack("<" + kind, value)

    def text(self, value: str) -> None:
        data = value.encode() + b"\0"
        self.number("I", len(data))
        self.bytes += data


def write(path: Path, images: List[Image], at_ms: Sequence[int]) -> None:
    """Writes a drive with these images, each at its log time."""
    records = [
        _record(HEADER, _text("ros2") + _text("tests")),
        _record(
            SCHEMA,
            struct.pack("<H", 1)
            + _text("sensor_msgs/msg/Image")
            + _text("ros2msg")
            + _text(DEFINITION),
        ),
        _record(
            CHANNEL, struct.pack("<HH", 1, 1) + _text(TOPIC) + _text("cdr") + struct.pack("<I", 0)
        ),
    ]
    for n, (image, ms) in enumerate(zip(images, at_ms)):
        at_ns = ms * 1_000_000
        records.append(
            _record(MESSAGE, struct.pack("<HIQQ", 1, n + 1, at_ns, at_ns - 5) + image.cdr())
        )
    records += [_record(DATA_END, bytes(4)), _record(FOOTER, bytes(20))]
    path.write_bytes(MAGIC + b"".join(records) + MAGIC)


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data
